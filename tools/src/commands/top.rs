//! `depthrig top`: the status of the running rig, refreshed in place.

use crate::context::Context;
use crate::exit::Exit;
use crate::screen::{self, Screen};
use crate::signals::Stop;
use crate::view::{self, Style};
use anyhow::Result;
use core::time::Duration;

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct TopArgs {
    /// Seconds between refreshes
    #[arg(long, value_name = "S", default_value = "1", value_parser = crate::args::positive_seconds)]
    interval: f64,
}

/// Polling interval of keys and signals.
const LOOK: Duration = Duration::from_millis(100);

/// Refreshes until q, Ctrl-C, or the end of the rig.
pub fn run(args: &TopArgs, context: &Context) -> Result<Exit> {
    let client = super::record::connect(context)?;
    client.status()?; // report an error before taking over the screen
    let stop = Stop::on_signals()?;
    let screen = Screen::enter()?;
    loop {
        let rig = client.status()?;
        let style = Style { width: screen::size().unwrap_or(screen::USUAL).0, color: context.color() };
        screen.draw(&format!("{}\n\nq leaves", view::status(&rig, style)))?;
        let until = depthrig_bus::HostTime::now().plus(Duration::from_secs_f64(args.interval));
        while !until.from_now().is_zero() {
            let key = screen.key(until.from_now().min(LOOK));
            if stop.is_asked() || matches!(key, Some(b'q' | b'Q')) {
                return Ok(Exit::Good);
            }
        }
    }
}
