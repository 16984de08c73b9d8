//! `depthrig cdm import`, `list`, `info` and `remove`: manages the installed models.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use clap::ValueEnum;
use core::ops::ControlFlow;
use depthrig_cdm::store::{Import, Installed, Record, Source, check_name};
use depthrig_cdm::{ChannelOrder, Encoder, ErrorKind, ModelStore, Weights, published, tiny, weights};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Examples of `cdm import`.
pub const IMPORT_EXAMPLES: &str = "\
FILE is a checkpoint for the official code (torch.save of {\"model\": ...} or of a state dict) or a .safetensors file.
No code in it is executed. If any tensor is missing, superfluous, of the wrong shape or not finite, all of them are
listed and nothing is installed.

Exit codes: 0 installed, 1 invalid checkpoint or failed installation, 2 wrong usage.

Examples:
  depthrig cdm import cdm_d435.ckpt --name cdm-d435
  depthrig cdm import finetuned.pth --name lab-d405 --camera D405 --input-size 392";

/// Examples of `cdm list`.
pub const LIST_EXAMPLES: &str = "\
Examples:
  depthrig cdm list
  depthrig cdm list --published     models that `cdm fetch` knows, with their cameras
  depthrig cdm list --json";

/// Examples of `cdm info`.
pub const INFO_EXAMPLES: &str = "\
Exit codes: 0 success, 1 the model is missing or damaged, 2 wrong usage.

Examples:
  depthrig cdm info cdm-d435
  depthrig cdm info tiny                 the network that is part of the program: its record
  depthrig cdm info cdm-d435 --check     verify every byte";

/// Selects the model folder.
#[derive(Debug, Clone, clap::Args)]
pub struct Models {
    /// Model folder [env: DEPTHRIG_MODELS] [default: ~/.local/share/depthrig/models]
    #[arg(long = "models", value_name = "DIR")]
    pub dir: Option<PathBuf>,
}

impl Models {
    /// Opens the store.
    ///
    /// # Errors
    /// When the model folder is unknown.
    pub fn store(&self) -> Result<ModelStore> {
        Ok(ModelStore::open(self.dir.as_deref())?)
    }
}

/// Order of the colour channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Channels {
    /// Blue first, as in the official inference script
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

/// Options of an installation.
#[derive(Debug, Clone, clap::Args)]
pub struct Settings {
    /// Colour channel order that the network was trained with
    #[arg(long, value_enum, default_value = "bgr", value_name = "ORDER")]
    channel_order: Channels,
    /// Shorter side of the network's input, pixels; rig files can override it
    #[arg(long, value_name = "PIXELS", default_value_t = depthrig_cdm::INPUT_SIZE)]
    input_size: u32,
    /// Farthest raw depth, metres; anything beyond is a hole
    #[arg(long, value_name = "METRES", default_value_t = depthrig_cdm::MAX_DEPTH_M, value_parser = crate::args::range_limit_m)]
    max_depth: f64,
    /// Camera model that it was trained for, such as D435; repeatable
    #[arg(long = "camera", value_name = "MODEL")]
    cameras: Vec<String>,
    /// Leave out tensors that the network lacks, and record their names
    #[arg(long)]
    drop_extra: bool,
    /// Replace an installed model of that name; running processes keep the old one
    #[arg(long)]
    replace: bool,
}

impl Settings {
    /// Builds the store's import request.
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
    /// Checkpoint file
    file: PathBuf,
    /// Name of the model [default: the published model's, else the file's]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Required encoder: vits, vitb, vitl or vitg [default: any]
    #[arg(long, value_name = "ENCODER", value_parser = encoder)]
    encoder: Option<Encoder>,
    #[command(flatten)]
    settings: Settings,
    #[command(flatten)]
    models: Models,
    /// Print JSON, including the problems of an invalid checkpoint
    #[arg(long)]
    json: bool,
}

/// Arguments of `cdm list`.
#[derive(Debug, clap::Args)]
pub struct ListArgs {
    /// List the published models instead of the installed ones
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
    /// Name of the model
    name: String,
    /// Verify every byte and number
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
    /// Name of the model
    name: String,
    #[command(flatten)]
    models: Models,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A model as JSON.
#[derive(Serialize)]
struct ModelReport<'a> {
    name: &'a str,
    id: String,
    path: &'a Path,
    #[serde(flatten)]
    record: &'a Record,
}

impl<'a> ModelReport<'a> {
    fn of(model: &'a Installed) -> Self {
        Self { name: &model.name, id: model.id(), path: &model.path, record: &model.record }
    }
}

/// The network of the program, as JSON.
#[derive(Serialize)]
struct BuiltIn {
    name: &'static str,
    id: &'static str,
    sha256: &'static str,
    bytes: u64,
    trained: bool,
    /// Whether `engine = "auto"` may choose it.
    default: bool,
}

impl BuiltIn {
    fn get() -> Self {
        let tiny::TinyModel { id, sha256, bytes, is_trained, is_default } = tiny::model();
        Self { name: TINY, id, sha256, bytes: *bytes, trained: *is_trained, default: *is_default }
    }
}

/// The name of the engine whose network is part of the program.
const TINY: &str = depthrig_cdm::EngineKind::Tiny.name();

/// A rejected checkpoint, as JSON.
#[derive(Serialize)]
struct Rejected<'a> {
    installed: bool,
    error: String,
    file: &'a Path,
    /// All problems; `None` when the file could not be read at all.
    report: Option<weights::Report>,
}

/// Installs a checkpoint.
pub fn import(args: &ImportArgs, context: &Context) -> Result<Exit> {
    let ImportArgs { file, name, encoder, settings, models, json } = args;
    let name = name.clone().map_or_else(|| name_of(file), Ok)?;
    let store = models.store()?;
    let stop = Stop::on_signals()?;
    let installed = Weights::open(file).and_then(|weights| {
        let source = Source::file(&weights)?;
        install(&store, &weights, settings.import(&name, *encoder, source), &stop, context)
    });
    let installed = match installed {
        Err(e) if *json && e.kind() == ErrorKind::BadModel => {
            let report = Weights::open(file).and_then(|w| weights::examine(&w, *encoder)).ok();
            out::json(&Rejected { installed: false, error: e.to_string(), file, report })?;
            return Ok(Exit::Failed);
        }
        other => other.map_err(usage)?,
    };
    print_installed(&installed, *json)?;
    Ok(Exit::Good)
}

/// Installs `weights` with a progress bar; Ctrl-C cancels it and leaves nothing behind.
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

/// Prints the installed model.
///
/// # Errors
/// When the output is closed.
pub fn print_installed(model: &Installed, json: bool) -> Result<()> {
    if json {
        return out::json(&ModelReport::of(model));
    }
    out::line(format_args!("installed {} in {}", model.id(), model.path.display()))?;
    out::line(text(model))
}

/// Turns an error about the input into a usage error.
pub fn usage(e: depthrig_cdm::Error) -> anyhow::Error {
    if e.kind() == ErrorKind::BadInput { UsageError(e.to_string()).into() } else { e.into() }
}

/// Derives the model's name from its file.
fn name_of(file: &Path) -> Result<String> {
    let name = file.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    if let Some(p) = published::PUBLISHED.iter().find(|p| p.file == name) {
        return Ok(p.name.to_owned());
    }
    let stem = file.file_stem().map_or_else(String::new, |n| n.to_string_lossy().replace([' ', '_'], "-"));
    check_name(&stem).map_err(|e| UsageError(format!("{e}; name the model with --name")))?;
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
        let good: Vec<_> = models.iter().filter_map(|(_, m)| m.as_ref().ok()).map(ModelReport::of).collect();
        let bad = models
            .iter()
            .filter_map(|(name, m)| Some(Damaged { name, error: m.as_ref().err()?.to_string() }));
        let bad: Vec<_> = bad.collect();
        let built_in = [BuiltIn::get()];
        let folder = store.dir();
        let all =
            serde_json::json!({ "folder": folder, "models": good, "damaged": bad, "built_in": built_in });
        out::json(&all)?;
    } else {
        if models.is_empty() {
            out::line(format_args!(
                "no model is installed in {}; `depthrig cdm list --published` lists the models to fetch",
                store.dir().display()
            ))?;
        }
        let rows = models.iter().map(|(name, model)| match model {
            Ok(m) => row(m),
            Err(e) => vec![name.clone(), format!("damaged: {e}")],
        });
        let header = ["model", "encoder", "trained", "cameras", "installed", "input", "size"];
        out::line(out::table(&header, 5, rows.chain([built_in_row()])))?;
    }
    Ok(if damaged { Exit::Failed } else { Exit::Good })
}

fn built_in_row() -> Vec<String> {
    let tiny = BuiltIn::get();
    let trained = if tiny.trained { "yes" } else { "NO" };
    let words = [TINY, "-", trained, "any", "in the program", "-"];
    words.map(str::to_owned).into_iter().chain([out::bytes(tiny.bytes)]).collect()
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

/// Prints the record of a model.
pub fn info(args: &InfoArgs) -> Result<Exit> {
    let store = args.models.store()?;
    let model = match store.info(&args.name) {
        // An installed model of the same name comes first.
        Err(e) if e.kind() == ErrorKind::NotFound && args.name == TINY => return built_in_info(args.json),
        other => other.map_err(usage)?,
    };
    if args.check {
        store.check(&args.name)?;
    }
    if args.json {
        out::json(&ModelReport::of(&model))?;
    } else {
        out::line(format_args!("{}  {}", model.id(), model.path.display()))?;
        out::line(text(&model))?;
        if args.check {
            out::line("  checked       every byte is as it was installed, every number is finite")?;
        }
    }
    Ok(Exit::Good)
}

/// Prints the record of the network that is part of the program.
fn built_in_info(json: bool) -> Result<Exit> {
    let tiny = BuiltIn::get();
    if json {
        out::json(
            &serde_json::json!({ "built_in": tiny, "record": toml::from_str::<toml::Table>(tiny::RECORD)? }),
        )?;
        return Ok(Exit::Good);
    }
    let auto = if tiny.default { "may choose it" } else { "does not choose it" };
    out::line(format_args!(
        "{}  in the program, {}; engine = \"auto\" {auto}",
        tiny.id,
        out::bytes(tiny.bytes)
    ))?;
    out::line(tiny::RECORD.trim_end())?;
    if !tiny.trained {
        out::line("NOT TRAINED: random weights")?;
    }
    Ok(Exit::Good)
}

/// Describes a model as text.
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
        lines.push("  NOT TRAINED   random weights: the output is not depth".to_owned());
    }
    lines.join("\n")
}

/// Removes a model.
pub fn remove(args: &RemoveArgs) -> Result<Exit> {
    args.models.store()?.remove(&args.name).map_err(usage)?;
    if args.json {
        out::json(&serde_json::json!({ "removed": args.name }))?;
    } else {
        out::line(format_args!("removed {}; running processes keep it until they exit", args.name))?;
    }
    Ok(Exit::Good)
}
