//! The IMUs of a rig, as the set thread reads them.
//!
//! Their batches are not in frame sets. They are read on the set thread all the same, because it is the one that hands
//! sets to the recording: a batch that was read before a set was handed over is in that set or in an earlier one, so
//! that nothing has to be put in order afterwards. A batch is copied where it is recorded and its slot let go at once.

use super::Inner;
use crate::camera::State;
use crate::status::SetAccount;
use crate::stream::Stream;
use depthrig_bus::{StreamId, Subscriber};
use std::sync::Arc;

/// One unit as the set thread sees it.
struct Input {
    stream: Arc<Stream>,
    subscriber: Subscriber,
    /// Number of the newest batch that was read.
    newest: u64,
}

/// The units whose channels are open.
#[derive(Default)]
pub struct Units(Vec<Input>);

impl Units {
    /// Takes in the units of a camera that opened since the last look.
    pub fn find(&mut self, state: &State) {
        for stream in state.streams.iter().filter(|s| s.profile.format.is_motion()) {
            // Taken once; the channel outlives the camera's sessions.
            if let Some(subscriber) = stream.books().reader.take() {
                self.0.push(Input { stream: Arc::clone(stream), subscriber, newest: 0 });
            }
        }
    }

    /// Reads new batches.
    pub fn read(&mut self, inner: &Inner) {
        for input in &mut self.0 {
            loop {
                match input.subscriber.try_next() {
                    Ok(Some(frame)) => {
                        // The rig numbers a stream's frames from 1, whoever listens.
                        let sequence = frame.header().sequence;
                        let missed = sequence.saturating_sub(input.newest + 1);
                        input.newest = sequence;
                        inner.recording().hear_motion(&input.stream.id, &frame, missed);
                    }
                    Ok(None) => break,
                    Err(e) => {
                        tracing::debug!(stream = %input.stream.id, error = %e, "cannot read");
                        break;
                    }
                }
            }
        }
    }

    /// Accounts of the batches of each IMU.
    pub fn accounts(&self, inner: &Inner) -> Vec<(StreamId, SetAccount)> {
        if self.0.is_empty() { Vec::new() } else { inner.recording().motion_accounts() }
    }
}
