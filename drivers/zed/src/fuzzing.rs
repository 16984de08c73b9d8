//! The body of the fuzz target `zed_conf`, which the test of its corpus also calls.

use super::command::{Command, parse_serial};
use super::conf::FactoryCalibration;
use super::mode::{Mode, Side};
use super::sensors::Record;

/// Bytes as a factory calibration, and as a command block, flash and motion record; whether they are a calibration.
///
/// # Panics
/// When a calibration is implausible, or changes by being written and read.
pub fn conf(bytes: &[u8]) -> bool {
    let _ = (Command::parse(bytes), parse_serial(bytes), Record::parse(bytes));
    let text = String::from_utf8_lossy(bytes);
    let Ok(read) = FactoryCalibration::parse(&text, "fuzz") else { return false };
    let known: Vec<_> = Mode::ALL.into_iter().filter_map(|m| Some((m, read.at(m)?))).collect();
    assert!(!known.is_empty(), "a calibration of no mode");
    for (mode, c) in &known {
        let (width, height) = mode.image_size();
        for side in Side::BOTH {
            let i = c.intrinsics(side);
            let inside = i.cx > 0.0 && i.cx < f64::from(width) && i.cy > 0.0 && i.cy < f64::from(height);
            assert!(i.fx > 0.0 && i.fy > 0.0 && inside && i.coeffs.iter().all(|k| k.is_finite()), "{i:?}");
        }
        let t = c.right_in_left.translation_m;
        // A shortest baseline that was turned may have lost a rounding.
        assert!((0.02 - 1e-12..0.4).contains(&c.baseline_m()) && t[0] > 0.0, "{t:?}");
    }
    // A file may have a baseline for each mode; what is written has one.
    let first = known.first().map(|(_, c)| c.baseline_m());
    if known.iter().all(|(_, c)| Some(c.baseline_m()) == first) {
        let again = FactoryCalibration::parse(&read.build(), "built");
        let again = again.unwrap_or_else(|e| panic!("what was written cannot be read: {e}"));
        for (mode, c) in known {
            let other = again.at(mode).unwrap_or_else(|| panic!("{mode:?} is gone"));
            assert_eq!((c.left, c.right), (other.left, other.right));
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use depthrig_corpus::inputs;

    #[test]
    fn svo2_files() {
        depthrig_corpus::run("zed_svo2", crate::replay::svo2::fuzz);
    }

    #[test]
    fn the_corpus_is_read_or_refused() {
        let mut seeds = 0;
        for input in inputs("zed_conf") {
            let is_one = super::conf(&input.bytes);
            if input.is_seed() {
                seeds += 1;
                assert!(is_one, "{} is no longer a valid calibration", input.name);
            }
        }
        assert!(seeds >= 3, "{seeds} seeds");
    }

    /// Pieces that a number, a line or a section is spoilt with.
    const PIECES: [&str; 16] = [
        "1e308",
        "-1e-320",
        "NaN",
        "inf",
        "-",
        "=",
        "[",
        "]",
        "\n",
        "\r",
        ";",
        "0",
        "9",
        ",",
        "\u{fffd}",
        "[STEREO]\nBaseline_HD=60\n",
    ];

    /// 20 000 files with up to four pieces put in, taken out or moved; two million with `DEPTHRIG_LONG=1`.
    #[test]
    fn spoilt_files_are_read_or_refused() {
        let rounds = if std::env::var_os("DEPTHRIG_LONG").is_some() { 2_000_000 } else { 20_000 };
        let seeds = inputs("zed_conf");
        let mut x = 0x2545_F491_4F6C_DD1D_u64;
        let mut random = |below: usize| {
            x ^= x << 13;
            x ^= x >> 7;
            x ^= x << 17;
            (x >> 11) as usize % below.max(1)
        };
        let mut still_good = 0;
        for _ in 0..rounds {
            let mut bytes = seeds[random(seeds.len())].bytes.clone();
            for _ in 0..=random(4) {
                let at = random(bytes.len() + 1);
                let end = (at + random(24)).min(bytes.len());
                match random(4) {
                    0 => drop(bytes.splice(at..at, PIECES[random(PIECES.len())].bytes())),
                    1 => drop(bytes.drain(at..end)),
                    2 => {
                        let piece = bytes[at..end].to_vec();
                        let to = random(bytes.len() + 1);
                        drop(bytes.splice(to..to, piece));
                    }
                    _ => {
                        if let Some(byte) = bytes.get_mut(at) {
                            *byte ^= 1 << random(8);
                        }
                    }
                }
            }
            still_good += u32::from(super::conf(&bytes));
        }
        assert!(still_good > rounds / 100, "{still_good} of {rounds} are still read: nothing is reached");
    }
}
