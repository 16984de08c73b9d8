//! `depthrig cdm import`, `list`, `info` and `remove`: the models of this computer.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use clap::ValueEnum;
use core::ops::ControlFlow;
use depthrig_cdm::store::{Import, Installed, Record, Source, check_name};
use depthrig_cdm::{ChannelOrder, Encoder, ErrorKind, ModelStore, Weights, published, weights};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Examples of `cdm import`.
pub const IMPORT_EXAMPLES: &str = "\
FILE is what the official code loads (torch.save of {\"model\": ...} or of a state dict) or a .safetensors file.
Nothing in it is run. Every tensor that is missing, too much, of another shape or not finite is listed, and then
nothing is installed.

Exit codes: 0 installed, 1 not a good checkpoint or it could not be installed, 2 wrong usage.

Examples:
  depthrig cdm import cdm_d435.ckpt --name cdm-d435
  depthrig cdm import finetuned.pth --name lab-d405 --camera D405 --input-size 392";

/// Examples of `cdm list`.
pub const LIST_EXAMPLES: &str = "\
Examples:
  depthrig cdm list
  depthrig cdm list --published     what `cdm fetch` knows, and the cameras each is for
  depthrig cdm list --json";

/// Examples of `cdm info`.
pub const INFO_EXAMPLES: &str = "\
Exit codes: 0 good, 1 there is no such model or it is damaged, 2 wrong usage.

Examples:
  depthrig cdm info cdm-d435
  depthrig cdm info cdm-d435 --check     read every byte again";

/// Which models are meant.
#[derive(Debug, Clone, clap::Args)]
pub struct Models {
    /// Folder of the models [env: DEPTHRIG_MODELS] [default: ~/.local/share/depthrig/models]
    #[arg(long = "models", value_name = "DIR")]
    pub dir: Option<PathBuf>,
}

impl Models {
    /// The store.
    ///
    /// # Errors
    /// When it is not known where models are.
    pub fn store(&self) -> Result<ModelStore> {
        Ok(ModelStore::open(self.dir.as_deref())?)
    }
}

/// The order of colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Channels {
    /// As the official inference script feeds the network, which turns the channels around twice
    Bgr,
    /// Red first
    Rgb,
}

impl From<Channels> for ChannelOrder {
    fn from(channels: Channels) -> Self {
        match channels {
            Channels::Bgr => Self::Bgr,
            Channels::Rgb => Self::Rgb,
        }
    }
}

/// How a model is to be installed.
#[derive(Debug, Clone, clap::Args)]
pub struct Settings {
    /// Order of the colour channels that the network was trained with
    #[arg(long, value_enum, default_value = "bgr", value_name = "ORDER")]
    channel_order: Channels,
    /// The shorter side of the network's input, pixels; the rig file may say another
    #[arg(long, value_name = "PIXELS", default_value_t = depthrig_cdm::INPUT_SIZE)]
    input_size: u32,
    /// Raw depth beyond this is a hole, metres
    #[arg(long, value_name = "METRES", default_value_t = depthrig_cdm::MAX_DEPTH_M, value_parser = crate::args::range_limit_m)]
    max_depth: f64,
    /// A camera model that it is for, such as D435; may be given several times
    #[arg(long = "camera", value_name = "MODEL")]
    cameras: Vec<String>,
    /// Leave out tensors that are not of the network, and write their names down
    #[arg(long)]
    drop_extra: bool,
    /// Replace an installed model of that name; who uses it keeps the old one
    #[arg(long)]
    replace: bool,
}

impl Settings {
    /// What the store wants to know.
    pub fn import(&self, name: &str, encoder: Option<Encoder>, source: Source) -> Import {
        let mut import = Import {
            encoder,
            channel_order: self.channel_order.into(),
            input_size: self.input_size,
            max_depth_m: self.max_depth,
            drop_extra: self.drop_extra,
            replace: self.replace,
            ..Import::new(name, source)
        };
        if !self.cameras.is_empty() {
            import.cameras.clone_from(&self.cameras);
        }
        import
    }
}

fn encoder(text: &str) -> Result<Encoder, String> {
    text.parse().map_err(|e: depthrig_cdm::Error| e.to_string())
}

/// Arguments of `cdm import`.
#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// The checkpoint
    file: PathBuf,
    /// What the model is to be called [default: the file's name; that of the published model for a published file]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// The size that it must be of: vits, vitb, vitl or vitg
    #[arg(long, value_name = "ENCODER", value_parser = encoder)]
    encoder: Option<Encoder>,
    #[command(flatten)]
    settings: Settings,
    #[command(flatten)]
    models: Models,
    /// Print JSON, also of what is wrong with the checkpoint
    #[arg(long)]
    json: bool,
}

/// Arguments of `cdm list`.
#[derive(Debug, clap::Args)]
pub struct ListArgs {
    /// List the published models in place of the installed ones
    #[arg(long)]
    published: bool,
    #[command(flatten)]
    models: Models,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Arguments of `cdm info`.
#[derive(Debug, clap::Args)]
pub struct InfoArgs {
    /// The model
    name: String,
    /// Read every byte and number again
    #[arg(long)]
    check: bool,
    #[command(flatten)]
    models: Models,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Arguments of `cdm remove`.
#[derive(Debug, clap::Args)]
pub struct RemoveArgs {
    /// The model
    name: String,
    #[command(flatten)]
    models: Models,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A model as JSON.
#[derive(Serialize)]
struct Told<'a> {
    name: &'a str,
    id: String,
    path: &'a Path,
    #[serde(flatten)]
    record: &'a Record,
}

impl<'a> Told<'a> {
    fn of(model: &'a Installed) -> Self {
        Self { name: &model.name, id: model.id(), path: &model.path, record: &model.record }
    }
}

/// A checkpoint that was refused, as JSON.
#[derive(Serialize)]
struct Refused<'a> {
    installed: bool,
    error: String,
    file: &'a Path,
    /// Everything that is wrong; none when it could not be read at all.
    report: Option<weights::Report>,
}

/// Installs a checkpoint.
pub fn import(args: &ImportArgs, context: &Context) -> Result<Exit> {
    let ImportArgs { file, name, encoder, settings, models, json } = args;
    let name = name.clone().map_or_else(|| name_of(file), Ok)?;
    let (store, stop) = (models.store()?, Stop::on_signals()?);
    let installed = Weights::open(file).and_then(|weights| {
        let source = Source::file(&weights)?;
        install(&store, &weights, settings.import(&name, *encoder, source), &stop, context)
    });
    let installed = match installed {
        Err(e) if *json && e.kind() == ErrorKind::BadModel => {
            let report = Weights::open(file).and_then(|w| weights::examine(&w, *encoder)).ok();
            out::json(&Refused { installed: false, error: e.to_string(), file, report })?;
            return Ok(Exit::Failed);
        }
        other => other.map_err(usage)?,
    };
    tell_installed(&installed, *json)?;
    Ok(Exit::Good)
}

/// Installs `weights` with a bar; Ctrl-C ends it and leaves nothing.
///
/// # Errors
/// Those of [`ModelStore::import`].
pub fn install(
    store: &ModelStore,
    weights: &Weights,
    import: Import,
    stop: &Stop,
    context: &Context,
) -> depthrig_cdm::Result<Installed> {
    let mut bar = Progress::new(context.global.quiet > 0);
    store.import(weights, import, &mut |what, done, total| {
        bar.set(what, done >> 20, total >> 20);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
}

/// Says what was installed.
///
/// # Errors
/// When the output is closed.
pub fn tell_installed(model: &Installed, json: bool) -> Result<()> {
    if json {
        return out::json(&Told::of(model));
    }
    out::line(format_args!("installed {} in {}", model.id(), model.path.display()))?;
    out::line(text(model))
}

/// What the person at the keyboard has to change is wrong usage.
pub fn usage(e: depthrig_cdm::Error) -> anyhow::Error {
    if e.kind() == ErrorKind::BadInput { UsageError(e.to_string()).into() } else { e.into() }
}

/// The name for a file that none was given for.
fn name_of(file: &Path) -> Result<String> {
    let name = file.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    if let Some(p) = published::PUBLISHED.iter().find(|p| p.file == name) {
        return Ok(p.name.to_owned());
    }
    let stem = file.file_stem().map_or_else(String::new, |n| n.to_string_lossy().replace([' ', '_'], "-"));
    check_name(&stem).map_err(|e| UsageError(format!("{e}; say what it is to be called with --name")))?;
    Ok(stem)
}

/// Lists models.
pub fn list(args: &ListArgs) -> Result<Exit> {
    if args.published {
        return list_published(args.json);
    }
    let store = args.models.store()?;
    let models = store.list()?;
    let damaged = models.iter().any(|(_, model)| model.is_err());
    if args.json {
        #[derive(Serialize)]
        struct Damaged<'a> {
            name: &'a str,
            error: String,
        }
        let good: Vec<_> = models.iter().filter_map(|(_, m)| m.as_ref().ok()).map(Told::of).collect();
        let bad = models
            .iter()
            .filter_map(|(name, m)| Some(Damaged { name, error: m.as_ref().err()?.to_string() }));
        let bad: Vec<_> = bad.collect();
        out::json(&serde_json::json!({ "folder": store.dir(), "models": good, "damaged": bad }))?;
    } else if models.is_empty() {
        out::line(format_args!(
            "no model is installed in {}; `depthrig cdm list --published` shows what there is to fetch",
            store.dir().display()
        ))?;
    } else {
        let rows = models.iter().map(|(name, model)| match model {
            Ok(m) => row(m),
            Err(e) => vec![name.clone(), format!("damaged: {e}")],
        });
        out::line(out::table(
            &["model", "encoder", "trained", "cameras", "installed", "input", "size"],
            5,
            rows,
        ))?;
    }
    Ok(if damaged { Exit::Failed } else { Exit::Good })
}

fn row(m: &Installed) -> Vec<String> {
    let r = &m.record;
    vec![
        m.name.clone(),
        r.encoder.to_string(),
        if r.trained { "yes" } else { "NO" }.to_owned(),
        if r.cameras.is_empty() { "-".to_owned() } else { r.cameras.join(", ") },
        r.installed.clone(),
        r.input_size.to_string(),
        out::bytes(r.weights.bytes),
    ]
}

fn list_published(json: bool) -> Result<Exit> {
    #[derive(Serialize)]
    struct Row {
        name: &'static str,
        repository: &'static str,
        file: &'static str,
        cameras: &'static [&'static str],
        licence: &'static str,
        sha256: Option<&'static str>,
        seen: bool,
    }
    let row = |p: &published::Published| {
        let published::Published { name, repository, file, sha256, licence, seen, cameras } = *p;
        Row { name, repository, file, cameras, licence, sha256, seen }
    };
    if json {
        out::json(&published::PUBLISHED.iter().map(row).collect::<Vec<_>>())?;
        return Ok(Exit::Good);
    }
    let rows = published::PUBLISHED.iter().map(|p| {
        let cameras = if p.cameras.is_empty() { "any".to_owned() } else { p.cameras.join(", ") };
        let place = format!("{}/{}{}", p.repository, p.file, if p.seen { "" } else { " (not seen)" });
        vec![p.name.to_owned(), cameras, p.licence.to_owned(), place]
    });
    out::line(out::table(&["model", "cameras", "licence", "file at huggingface.co"], 9, rows))?;
    Ok(Exit::Good)
}

/// Says what is known of a model.
pub fn info(args: &InfoArgs) -> Result<Exit> {
    let store = args.models.store()?;
    let model = store.info(&args.name).map_err(usage)?;
    if args.check {
        store.check(&args.name)?;
    }
    if args.json {
        out::json(&Told::of(&model))?;
    } else {
        out::line(format_args!("{}  {}", model.id(), model.path.display()))?;
        out::line(text(&model))?;
        if args.check {
            out::line("  checked       every byte is as it was installed, every number is finite")?;
        }
    }
    Ok(Exit::Good)
}

/// A model for people.
fn text(model: &Installed) -> String {
    let r = &model.record;
    let or_none = |text: String| if text.is_empty() { "-".to_owned() } else { text };
    let channels = match r.channel_order {
        ChannelOrder::Bgr => "bgr (as the official script)",
        ChannelOrder::Rgb => "rgb",
    };
    let mut lines = vec![
        format!(
            "  encoder       {}, {} tensors, {}",
            r.encoder,
            r.weights.tensors,
            out::bytes(r.weights.bytes)
        ),
        format!(
            "  input         {} pixels, channels {channels}, depth up to {} m",
            r.input_size, r.max_depth_m
        ),
        format!("  cameras       {}", or_none(r.cameras.join(", "))),
        format!("  installed     {} by {}", r.installed, r.installed_by),
        format!("  sha256        {}", r.weights.sha256),
    ];
    match &r.source {
        Source::File { path, sha256, .. } => {
            lines.push(format!("  from          {path}"));
            lines.push(format!("  its sha256    {sha256}"));
        }
        Source::Fetched { url, revision, sha256, compared_with, licence, .. } => {
            lines.push(format!("  from          {url}"));
            lines.extend(revision.iter().map(|r| format!("  revision      {r}")));
            lines.push(format!("  its sha256    {sha256} (compared with: {compared_with})"));
            lines.push(format!("  licence       {licence}"));
        }
    }
    if !r.left_out.is_empty() {
        lines.push(format!("  left out      {}", r.left_out.join(", ")));
    }
    if !r.trained {
        lines.push("  NOT TRAINED   random numbers: what it gives is no depth".to_owned());
    }
    lines.join("\n")
}

/// Removes a model.
pub fn remove(args: &RemoveArgs) -> Result<Exit> {
    args.models.store()?.remove(&args.name).map_err(usage)?;
    if args.json {
        out::json(&serde_json::json!({ "removed": args.name }))?;
    } else {
        out::line(format_args!("removed {}; who uses it keeps it until they let go", args.name))?;
    }
    Ok(Exit::Good)
}
