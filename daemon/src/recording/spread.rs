//! How far apart in time the frames of a recorded set may be, which `verify` holds a dataset to.

use super::StreamFacts;
use crate::rig::near_pair_ns;
use depthrig_stereo::{COLOR, SIDES, StereoOptions};

/// How far from the tick the frame of a stream may be: half of its period and a millisecond (see `sets`). Depth by stereo is
/// of the set's pair or of one that stands in for it. `None` when the stream does not say how fast it is.
pub(super) fn reach_ns<'s>(
    of: &StreamFacts,
    mut streams: impl Iterator<Item = &'s StreamFacts>,
    sets_hz: f64,
) -> Option<i64> {
    let half = |hz: f64| (hz > 0.0).then(|| (0.5e9 / hz).ceil() as i64 + 1_000_000);
    let is_source = |s: &&StreamFacts| {
        let id = &s.stream.id;
        let name = s.stream.id.stream.as_str();
        id.camera == of.stream.id.camera && (name == COLOR || SIDES.contains(&name))
    };
    let late = StereoOptions::is_late(of.stream.id.stream.as_str());
    let Some(pairs) = streams.find(is_source).filter(|_| late) else {
        return half(of.stream.profile.rate_hz);
    };
    let pairs = &pairs.stream.profile;
    half(pairs.rate_hz).map(|ns| ns + near_pair_ns(pairs.period_ns() as i64, (1e9 / sets_hz) as i64))
}

/// How far apart the frames of one set may be: the two that reach farthest, on either side of the tick.
pub(super) fn max_spread_ns(reaches: impl Iterator<Item = Option<i64>>) -> Option<i64> {
    let mut reaches = reaches.collect::<Option<Vec<_>>>()?;
    reaches.sort_unstable();
    Some(reaches.iter().rev().take(2).sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stream::Stream;
    use depthrig_bus::{Intrinsics, MetadataLevel, Name, PixelFormat, Pose};
    use depthrig_driver::{DeviceClock, StreamProfile};
    use std::sync::Arc;

    fn facts(name: &str, rate_hz: f64) -> StreamFacts {
        let profile = StreamProfile {
            stream: Name::new(name).unwrap(),
            format: PixelFormat::Z16,
            width: 8,
            height: 8,
            rate_hz,
            depth_unit_m: 0.001,
            intrinsics: Intrinsics::default(),
            pose_in_device: Pose::IDENTITY,
            clock: DeviceClock::microseconds(32),
            sequence_bits: 32,
            metadata: MetadataLevel::Simulated,
        };
        let id = format!("cam/{name}").parse().unwrap();
        StreamFacts {
            stream: Arc::new(Stream::new(id, profile, true, 4)),
            model: String::new(),
            serial: String::new(),
            firmware: String::new(),
            calibration: String::new(),
            camera_pose: Pose::IDENTITY,
            computed: None,
        }
    }

    #[test]
    fn the_limit_of_the_spread_is_what_the_two_slowest_streams_allow() {
        let spread = |streams: &[(&str, f64)]| {
            let streams: Vec<_> = streams.iter().map(|(name, hz)| facts(name, *hz)).collect();
            max_spread_ns(streams.iter().map(|s| reach_ns(s, streams.iter(), 5.0)))
        };
        // Half of 40 ms and half of 100 ms, and a millisecond for each.
        assert_eq!(spread(&[("a", 25.0), ("b", 10.0), ("c", 30.0)]), Some(72_000_000));
        assert_eq!(spread(&[("a", 30.0), ("b", 0.0)]), None);
        // Depth of every sixth pair is of the set's pair or of the one beside it.
        assert_eq!(
            spread(&[("left", 25.0), ("depth_quality", 5.0)]),
            Some(21_000_000 + 21_000_000 + 44_000_000)
        );
        // Where pairs are as rare as sets, no other one stands in but one that is near.
        assert_eq!(spread(&[("left", 5.0), ("depth_quality", 5.0)]), Some(2 * 101_000_000 + 90_000_000));
    }
}
