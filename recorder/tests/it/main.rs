//! Datasets from the outside: written, read, damaged, and read by the `mcap` crate's own reader.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod cat;
mod catalog;
mod codecs;
mod compare;
mod corpus;
mod crash;
mod edit;
mod episodes;
mod failures;
mod kill;
mod kill_busy;
mod logged;
mod motion;
mod prune;
mod recover;
mod report;
mod resume;
mod round_trip;
mod set_reader;
mod signals;
mod slice;
mod stereo;
mod structure;
mod support;
mod verify;
