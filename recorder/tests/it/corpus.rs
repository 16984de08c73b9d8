//! The corpus of the fuzz targets as tests: inputs that a fuzzer once found interesting or that failed keep passing.

use depthrig_corpus::inputs;
use depthrig_recorder::fuzzing;
use proptest::prelude::*;

/// Runs each input, and checks that the seeds still reach the code that they were written for.
fn run<T: PartialOrd + Copy + std::fmt::Debug>(
    target: &str,
    reached: impl Fn(&[u8]) -> T,
    seeds_reach_more_than: T,
) {
    let mut seeds = 0;
    for input in inputs(target) {
        println!("{target}/{}", input.name);
        let far = reached(&input.bytes);
        if input.is_seed() {
            seeds += 1;
            assert!(
                far > seeds_reach_more_than,
                "{target}/{} reaches {far:?}: write the seeds again",
                input.name
            );
        }
    }
    assert!(seeds > 0, "{target} has no seeds");
}

#[test]
fn segments() {
    run("segment", fuzzing::segment, 1);
}

#[test]
fn recovered_segments() {
    run("recover", fuzzing::recover, 1);
    for input in inputs("segment") {
        println!("segment/{}", input.name);
        fuzzing::recover(&input.bytes);
    }
}

#[test]
fn depth_images() {
    run("depth_codec", fuzzing::depth_codec, false);
}

#[test]
fn color_images() {
    run("color_codec", fuzzing::color_codec, false);
}

#[test]
fn sessions() {
    run("session", fuzzing::session, false);
}

/// Changes a few bytes, or cuts or repeats some.
fn change(bytes: &[u8], seed: u64) -> Vec<u8> {
    let mut out = bytes.to_vec();
    let mut x = seed | 1;
    let mut next = |n: usize| {
        // xorshift64
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x % n.max(1) as u64) as usize
    };
    for _ in 0..=next(3) {
        let at = next(out.len());
        let len = next(9);
        let end = (at + len).min(out.len());
        match next(5) {
            0 => drop(out.drain(at..end)),
            1 => {
                let part = out[at..end].to_vec();
                out.splice(at..at, part);
            }
            2 => out[at..end].fill([0, 0xff, 0x7f][next(3)]),
            _ if at < out.len() => out[at] ^= 1 << next(8),
            _ => {}
        }
    }
    out
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(if std::env::var_os("DEPTHRIG_LONG").is_some() { 50_000 } else { 400 }))]
    /// Fuzzing in short, with the same mutations: on any computer, without the tools.
    #[test]
    fn damaged_segments_end_in_errors(seeds in proptest::collection::vec(any::<u64>(), 1..4), file in any::<usize>()) {
        let all = inputs("segment");
        let mut bytes = all[file % all.len()].bytes.clone();
        for seed in seeds {
            let mut plain = |b: &[u8]| change(b, seed);
            bytes = fuzzing::mcap::mutate(&bytes, seed, &mut plain).unwrap_or_else(|| change(&bytes, seed));
        }
        fuzzing::segment(&bytes);
        fuzzing::recover(&bytes);
    }
}

/// The mutations are effective: many leave readable sets, and the checksums are corrected.
#[test]
fn mutations_get_behind_the_checksums() {
    let seed = inputs("segment").into_iter().find(|input| input.name == "seed_jpeg").unwrap().bytes;
    let whole = fuzzing::segment(&seed);
    let mut broken_sets = 0;
    for n in 0..200 {
        if let Some(bytes) = fuzzing::mcap::mutate(&seed, n, &mut |b| change(b, n)) {
            let sets = fuzzing::segment(&bytes);
            broken_sets += u64::from(sets > 0 && sets < whole);
        }
    }
    assert!(broken_sets > 10, "{broken_sets} of 200 mutations broke a set and left another");
    let mut file = fuzzing::mcap::File::parse(&seed).unwrap();
    file.mend_checksums();
    assert_eq!(file.to_bytes(), seed, "a good file has good checksums");
}
