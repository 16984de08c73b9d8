//! Two hosts' clocks by hand: `two_clocks answer ADDRESS` on one, `two_clocks ask ADDRESS SECONDS` on the other.
//!
//! The second prints, five hundred times a second, its time, the offset of the other host's clock, the bound of its error, the epoch, the rate in
//! ppm and the newest round trip; all times in nanoseconds.

use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_link::{Answerer, Asker, Trust};
use std::error::Error;
use std::io::{self, Read, Write};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        ["answer", address] => {
            let answerer = Answerer::start(address.parse()?, Trust::Anyone)?;
            println!("{}", answerer.address());
            // Until the one who started this closes its input.
            io::stdin().read_to_end(&mut Vec::new())?;
            println!("answered {} refused {}", answerer.answered(), answerer.refused());
            Ok(())
        }
        ["ask", address, seconds] => ask(address, seconds.parse()?),
        _ => Err("two_clocks answer ADDRESS | two_clocks ask ADDRESS SECONDS".into()),
    }
}

fn ask(address: &str, seconds: f64) -> Result<(), Box<dyn Error>> {
    let asker = Asker::start(address.parse()?, Trust::Anyone)?;
    let mut out = io::BufWriter::new(io::stdout().lock());
    let end = HostTime::now().plus(Duration::from_secs_f64(seconds));
    while HostTime::now() < end {
        std::thread::sleep(Duration::from_millis(2));
        let now = HostTime::now();
        if let Some(r) = asker.at(now) {
            let state = asker.state();
            writeln!(
                out,
                "{} {} {} {} {:.3} {}",
                now.ns(),
                r.offset_ns,
                r.uncertainty_ns,
                r.epoch,
                r.rate * 1e6,
                state.round_trip_ns
            )?;
        }
    }
    let s = asker.state();
    writeln!(out, "# asked {} answered {} refused {} bends {}", s.asked, s.answered, s.refused, s.bends)?;
    Ok(())
}
