//! PNG and JPEG of a colour stream.
#![no_main]

use depthrig_recorder::fuzzing;
use libfuzzer_sys::fuzz_target;
use std::panic;

fuzz_target!(
    init: {
        // libFuzzer's hook ends the process at each panic. Those of the JPEG decoder become errors in depthrig.
        let ends = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            if !info.location().is_some_and(|at| at.file().contains("/libjpeg-turbo-rs-")) {
                ends(info);
            }
        }));
    },
    |bytes: &[u8]| {
        fuzzing::color_codec(bytes);
    }
);
