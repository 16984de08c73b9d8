//! `depthrig cdm fetch`: downloads, verifies and installs a published checkpoint.

use super::store::{Models, Settings, install, print_installed, usage};
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use core::ops::ControlFlow;
use depthrig_cdm::fetch::{FetchOptions, fetch};
use depthrig_cdm::store::Source;
use depthrig_cdm::{Error, ErrorKind, Weights, published};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The published models are large (5.5 GB to download, 2.6 GB installed). Running the command again resumes an
interrupted download. The SHA-256 is compared with --sha256, else with the one built in, else with the one that the
server reports; the model's record says which.

Environment: HTTPS_PROXY, NO_PROXY; HF_TOKEN for models that require an account; HF_ENDPOINT for a mirror.

Exit codes: 0 installed, 1 download failed or invalid checkpoint, 2 wrong usage.

Examples:
  depthrig cdm fetch cdm-d435
  depthrig cdm fetch lab-d405 --url https://example.org/lab_d405.pth --sha256 6f1e... --camera D405";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct FetchArgs {
    /// Published model (see `cdm list --published`), or the name for --url
    name: String,
    /// URL of a checkpoint that is not a published one
    #[arg(long, value_name = "URL")]
    url: Option<String>,
    /// Expected SHA-256 of the file
    #[arg(long, value_name = "HEX")]
    sha256: Option<String>,
    /// Revision of the repository
    #[arg(long, value_name = "REVISION", default_value = "main")]
    revision: String,
    #[command(flatten)]
    settings: Settings,
    #[command(flatten)]
    models: Models,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Downloads and installs a checkpoint.
pub fn run(args: &FetchArgs, context: &Context) -> Result<Exit> {
    let store = args.models.store()?;
    let import = args.settings.import(
        &args.name,
        None,
        Source::File { path: String::new(), sha256: String::new(), bytes: 0 },
    );
    if !import.replace && store.info(&args.name).is_ok() {
        let text = format!("a model {} is installed already; replace it with --replace", args.name);
        return Err(usage(Error::new(ErrorKind::BadInput, text)));
    }
    let set = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
    let options = FetchOptions {
        endpoint: set("HF_ENDPOINT"),
        url: args.url.clone(),
        revision: args.revision.clone(),
        sha256: args.sha256.clone(),
        token: set("HF_TOKEN").filter(|_| args.url.is_none()),
        ..FetchOptions::default()
    };
    if let Some(p) =
        published::published(&args.name).filter(|_| args.url.is_none() && context.global.quiet == 0)
    {
        out::note(format_args!(
            "{}: licence {}; see https://huggingface.co/{}",
            p.name, p.licence, p.repository
        ));
    }
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let fetched = fetch(&store, &args.name, &options, &mut |what, done, total| {
        bar.set(what, done >> 20, total >> 20);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .map_err(usage)?;
    bar.clear();
    let weights = Weights::open(&fetched.path)?;
    let import = depthrig_cdm::store::Import { source: fetched.source.clone(), ..import };
    let installed = install(&store, &weights, import, &stop, context).map_err(usage)?;
    fetched.discard();
    print_installed(&installed, args.json)?;
    if let Source::Fetched { sha256, compared_with, .. } = &fetched.source
        && compared_with == "nothing"
        && !args.json
    {
        out::line(format_args!(
            "no SHA-256 of this file was known; the one that came is written down: {sha256}"
        ))?;
    }
    Ok(Exit::Good)
}
