//! The command line of depthrig.
fn main() {}
