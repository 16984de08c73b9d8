//! A rosbag, read to its end.
#![no_main]

use depthrig_convert::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::rosbag(bytes);
});
