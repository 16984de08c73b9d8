//! `depthrig open`: shows the running rig in a browser.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use anyhow::{Context as _, Result, bail};
use serde::Serialize;
use std::path::Path;
use std::process::{Command, Stdio};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The address ends in the token of the rig, which lets everybody who has it see and record: do not pass it on.
From another computer: `ssh -L 8642:localhost:8642 HOST`, and there the address that `depthrig open --print` prints on HOST.

Examples:
  depthrig open
  depthrig open --print --rig mount
  depthrig open --foxglove        the address to open as \"Foxglove WebSocket\" in Foxglove or Lichtblick";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct OpenArgs {
    /// Print the address and start no browser
    #[arg(long)]
    print: bool,
    /// Print JSON and start no browser
    #[arg(long)]
    json: bool,
    /// Print the address for Foxglove and Lichtblick instead
    #[arg(long)]
    foxglove: bool,
}

#[derive(Serialize)]
struct Address {
    url: String,
}

/// The token of a rig, from its file.
fn token(file: &Path) -> Result<String> {
    let token = std::fs::read_to_string(file)
        .with_context(|| format!("{}: the token of the page cannot be read", file.display()))?;
    Ok(token.trim_end().to_owned())
}

/// Finds the page and opens it.
pub fn run(args: &OpenArgs, context: &Context) -> Result<Exit> {
    let client = super::record::connect(context)?;
    let page = client.page()?;
    if args.foxglove {
        let (Some(address), Some(token_file)) = (page.foxglove, page.token_file) else {
            bail!(
                "rig {} does not serve Foxglove; start it with --foxglove, or write foxglove = 8765 into [control]",
                client.rig()
            );
        };
        let url = format!("{address}{}", token(&token_file)?);
        if args.json {
            out::json(&Address { url })?;
        } else {
            out::line(&url)?;
        }
        return Ok(Exit::Good);
    }
    let (Some(url), Some(token_file)) = (page.url, page.token_file) else {
        bail!(
            "rig {} serves no page: its configuration has tcp = \"off\" in [control], or no port was free; `depthrig top` shows it in the terminal",
            client.rig()
        );
    };
    let url = format!("{url}#token={}", token(&token_file)?);
    if args.json {
        out::json(&Address { url })?;
        return Ok(Exit::Good);
    }
    if args.print {
        out::line(&url)?;
        return Ok(Exit::Good);
    }
    // The address is not given to a shell, and its fragment goes to no server.
    let started = Command::new("xdg-open")
        .arg(&url)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    match started {
        Ok(status) if status.success() => out::line(format_args!("opened    {}", client.rig()))?,
        _ => {
            out::note(format_args!("no browser could be started here (xdg-open); open this address in one:"));
            out::line(&url)?;
        }
    }
    Ok(Exit::Good)
}
