//! Claims about a device that is asked for its clock, from its very first frame on: frames that all wait for an
//! overloaded computer from the beginning, a crystal that drifts, and answers that come when they come.

use super::sim::{self, NOMINAL, Scenario, generate};
use super::{ClockMap, Outcome, coverage, host, play};
use depthrig_bus::FrameFlags;
use proptest::prelude::*;

/// A device and how it answers.
#[derive(Debug, Clone, Copy)]
struct Case {
    fps: f64,
    /// Queueing that every frame has from the first one on.
    base_ns: f64,
    jitter_ns: f64,
    rate_ppm: f64,
    /// When the first answer comes, and how long it is from one to the next.
    first_s: f64,
    every_s: f64,
    /// The shortest way there, and the shortest way back.
    way_ns: f64,
    seed: u64,
}

fn any_case() -> impl Strategy<Value = Case> {
    let device = (prop_oneof![Just(15.0), Just(30.0), Just(60.0), Just(90.0)], -80.0..80.0f64);
    let transport = (0.0..40e6f64, 20e3..0.5e6f64, 50e3..2e6f64);
    let answers = (0.0..8.0f64, 0.1..3.0f64);
    (device, transport, answers, any::<u64>()).prop_map(
        |((fps, rate_ppm), (base_ns, jitter_ns, way_ns), (first_s, every_s), seed)| Case {
            fps,
            base_ns,
            jitter_ns,
            rate_ppm,
            first_s,
            every_s,
            way_ns,
            seed,
        },
    )
}

/// Maps 20 s of it.
fn outcomes_of(case: &Case) -> Vec<Outcome> {
    let s = Scenario {
        seconds: 20.0,
        fps: case.fps,
        rate_ppm: case.rate_ppm,
        base_ns: case.base_ns,
        jitter_ns: case.jitter_ns,
        stall_share: 0.0,
        ..NOMINAL
    };
    let mut map = ClockMap::new(super::config_of(&s));
    map.expect_probes();
    let mut rng = sim::Rng::new(case.seed ^ 0x5eed);
    let mut outcomes = Vec::new();
    let mut next_s = case.first_s;
    for (i, frame) in generate(&s, case.seed).iter().enumerate() {
        let at_s = i as f64 / s.fps;
        outcomes.extend(play(&mut map, core::slice::from_ref(frame)));
        outcomes[i].at_s = at_s;
        if at_s >= next_s {
            next_s = at_s + case.every_s;
            let way = |rng: &mut sim::Rng| case.way_ns + rng.exponential(100e3);
            let there = way(&mut rng);
            let back = way(&mut rng);
            let read_ns = frame.truth_ns + 5e6;
            let raw = frame.raw.wrapping_add((5e6 / s.tick_ns) as u64) & (u64::MAX >> (64 - s.counter_bits));
            map.probe(host(read_ns - there), raw, host(read_ns + back));
        }
    }
    outcomes
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]
    /// Of the frames whose time is claimed to be known, 99 of 100 are right within their claim; and every frame is
    /// claimed soon after the first answer.
    #[test]
    fn claims_hold_from_the_first_frame_on(case in any_case()) {
        let outcomes = outcomes_of(&case);
        let certain: Vec<Outcome> =
            outcomes.iter().filter(|o| !o.has(FrameFlags::TIME_UNCERTAIN)).copied().collect();
        prop_assert!(certain.iter().all(|o| o.at_s > case.first_s), "claimed before the first answer");
        let late = case.first_s + 1.0;
        let uncertain = outcomes.iter().filter(|o| o.at_s > late && o.has(FrameFlags::TIME_UNCERTAIN)).count();
        prop_assert!(uncertain * 100 <= outcomes.len(), "{uncertain} are still uncertain");
        let (covered, _) = coverage(&certain, 0.0);
        prop_assert!(covered >= 0.99, "covered {covered}");
    }
}

/// A device that never answers is never claimed to be known; one that nobody asks is, but for its constant latency.
#[test]
fn without_an_answer_nothing_is_claimed() {
    let s = Scenario { seconds: 10.0, base_ns: 25e6, ..NOMINAL };
    for asked in [true, false] {
        let mut map = ClockMap::new(super::config_of(&s));
        if asked {
            map.expect_probes();
        }
        let outcomes = play(&mut map, &generate(&s, 1));
        let certain = outcomes[10..].iter().filter(|o| !o.has(FrameFlags::TIME_UNCERTAIN)).count();
        assert_eq!(certain == 0, asked, "{certain} of {}", outcomes.len());
    }
}
