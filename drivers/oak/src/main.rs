//! `depthrig-oak`: an OAK camera as a camera that another process serves, over the `depthai` crate (docs/external.md).
//!
//! The crate's frames have neither time nor number, so these carry the time of their arrival here and say so. The
//! Python bridge (`python -m depthrig.oak`) has both; this is for who wants no Python and can do without them.

mod arguments;
#[cfg(any(feature = "native", feature = "no-native"))]
mod camera;
#[cfg(any(feature = "native", feature = "no-native"))]
mod serve;

use std::process::ExitCode;

/// An error that ends the program, with a message for the user.
type Error = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let outcome = arguments::read(std::env::args().skip(1)).and_then(|wishes| run(&wishes));
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("depthrig-oak: {e}");
            ExitCode::FAILURE
        }
    }
}

#[cfg(any(feature = "native", feature = "no-native"))]
fn run(wishes: &arguments::Wishes) -> Result<(), Error> {
    serve::run(wishes)
}

#[cfg(not(any(feature = "native", feature = "no-native")))]
fn run(wishes: &arguments::Wishes) -> Result<(), Error> {
    let (width, height) = wishes.size;
    Err(format!(
        "built without depthai-core, so no camera can be served at {width}x{height}; build it with \
         `DEPTHAI_CORE_ROOT=… cargo build --release --features native`"
    )
    .into())
}
