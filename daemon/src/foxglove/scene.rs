//! The channels that a rig has, and the times of their messages.

use super::protocol::{self, Channel};
use crate::Result;
use crate::control::LiveRig;
use depthrig_bus::{StreamId, UtcPair};
use depthrig_recorder::{LiveChannel, LiveSource, LiveTopics, RecorderOptions};
use hyper::body::Bytes;
use std::collections::BTreeMap;

/// The offset of UTC is taken anew when it has moved so far: the clock was set, or a replay came to another dataset.
const UTC_STEP_NS: i64 = 10_000_000;

/// Numbers of channels by what a client knows of them: a channel that changes gets another number.
pub(super) type Numbers = BTreeMap<Known, u32>;

/// A channel as a client knows it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Known {
    topic: String,
    schema_name: String,
}

/// The channels of a rig.
pub(crate) struct Scene {
    topics: LiveTopics,
    options: RecorderOptions,
    /// By their numbers.
    channels: BTreeMap<u32, LiveChannel>,
    utc: UtcPair,
}

impl Scene {
    pub(super) fn new(live: LiveRig, numbers: &mut Numbers) -> Result<Self> {
        let LiveRig { session, options, utc } = live;
        let topics = LiveTopics::new(session, &options)
            .map_err(|e| crate::Error::new(crate::ErrorKind::Other, e.to_string()))?;
        let channels = topics.channels().iter().map(|channel| {
            let known = Known { topic: channel.topic.clone(), schema_name: channel.schema_name.clone() };
            let next = numbers.len() as u32 + 1;
            (*numbers.entry(known).or_insert(next), channel.clone())
        });
        let channels = channels.collect();
        Ok(Self { topics, options, channels, utc })
    }

    /// Whether these are the channels of `live`, and their times still right.
    pub(super) fn is_of(&self, live: &LiveRig) -> bool {
        let session = self.topics.session();
        session.streams == live.session.streams
            && session.motion == live.session.motion
            && self.options == live.options
            && (offset_ns(&live.utc) - self.utc_offset_ns()).abs() < UTC_STEP_NS
    }

    pub(super) const fn topics(&self) -> &LiveTopics {
        &self.topics
    }

    pub(super) const fn options(&self) -> &RecorderOptions {
        &self.options
    }

    /// Nanoseconds that make UTC of a time of the host.
    pub(super) fn utc_offset_ns(&self) -> i64 {
        offset_ns(&self.utc)
    }

    /// Content of a channel, if there is such a channel.
    pub(super) fn source(&self, channel: u32) -> Option<LiveSource> {
        self.channels.get(&channel).map(|c| c.source)
    }

    /// The stream or IMU that a channel is of.
    pub(super) fn stream(&self, source: LiveSource) -> Option<&StreamId> {
        let session = self.topics.session();
        match source {
            LiveSource::Image(i) | LiveSource::CameraInfo(i) | LiveSource::FrameInfo(i) => {
                session.streams.get(i).map(|s| &s.id)
            }
            LiveSource::Imu(i) => session.motion.get(i).map(|u| &u.id),
            LiveSource::TfStatic | LiveSource::Diagnostics => None,
        }
    }

    /// The message of `/tf_static`.
    pub(super) fn tf_static(&self, subscription: u32) -> Bytes {
        let mut payload = Vec::new();
        self.topics.tf_static(&mut payload, self.utc.utc_ns);
        protocol::message(subscription, self.utc.utc_ns, &payload).into()
    }

    /// The numbers of the channels.
    pub(crate) fn numbers(&self) -> impl Iterator<Item = u32> + '_ {
        self.channels.keys().copied()
    }

    /// The channels with these numbers, as they are announced.
    pub(crate) fn announced(&self, numbers: &[u32]) -> Vec<Channel<'_>> {
        let chosen = self.channels.iter().filter(|(number, _)| numbers.contains(number));
        chosen
            .map(|(id, channel)| Channel {
                id: *id,
                topic: &channel.topic,
                encoding: "cdr",
                schema_name: &channel.schema_name,
                schema: &channel.schema,
                schema_encoding: "ros2msg",
            })
            .collect()
    }
}

fn offset_ns(pair: &UtcPair) -> i64 {
    pair.utc_ns - pair.mono.ns()
}
