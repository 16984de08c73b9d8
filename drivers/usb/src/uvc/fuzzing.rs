//! Entry points of the fuzz targets `uvc_*`: bytes that may be anything, as a device could send them.
//!
//! A panic is a finding; so is a broken promise, which is why there are assertions here. Each function returns how
//! far its input came, so that a corpus which no longer reaches anything is noticed.

use super::descriptors::{Configuration, Intervals};
use super::probe::Probe;

/// A configuration descriptor; the number of frame sizes that were read.
///
/// # Panics
/// When something that was read cannot be found again, or lies outside of its own bounds.
pub fn descriptors(bytes: &[u8]) -> u64 {
    let Ok(configuration) = Configuration::parse(bytes) else { return 0 };
    assert_eq!(configuration, Configuration::parse(bytes).unwrap_or_default(), "read twice, the same");
    let _ = configuration.vendor_channel();
    let mut sizes = 0;
    for stream in &configuration.streams {
        let owner = configuration.control_of(stream.number);
        assert!(owner.is_none_or(|c| c.streams.contains(&stream.number)));
        if let Some((setting, endpoint)) = stream.image_endpoint() {
            assert_eq!(endpoint.address, stream.endpoint);
            assert!(stream.settings.iter().any(|s| s.number == setting));
        }
        for (format, size) in stream.formats.iter().flat_map(|f| f.frames.iter().map(move |s| (f, s))) {
            sizes += 1;
            let found = stream.find(format.format(), size.width.into(), size.height.into());
            assert!(found.is_some(), "{size:?} is not found");
            let _ = size.bytes(format);
            match &size.intervals {
                Intervals::Discrete(list) => {
                    for interval in list.iter().filter(|i| i.0 > 0) {
                        let rate = interval.rate_hz();
                        let got = size.interval_for(rate);
                        assert!(
                            got.is_some_and(|g| (g.rate_hz() / rate - 1.0).abs() < 0.01),
                            "{rate}: {got:?}"
                        );
                    }
                }
                Intervals::Continuous { min, max, .. } => {
                    for rate in [1.0, 30.0, min.rate_hz(), max.rate_hz()] {
                        if let Some(got) = size.interval_for(rate) {
                            assert!(*min <= got && got <= *max.max(min), "{got:?} of {size:?}");
                        }
                    }
                }
            }
        }
    }
    sizes
}

/// A probe block; 1 when it was read.
///
/// # Panics
/// When writing it changes it.
pub fn probe(bytes: &[u8]) -> u64 {
    let Ok(probe) = Probe::parse(bytes) else { return 0 };
    assert_eq!(probe.build(), bytes);
    let wish = probe.wish(1, 2, 3).build();
    assert_eq!(wish.len(), bytes.len());
    1
}

#[cfg(test)]
mod tests {
    use depthrig_corpus::run;

    #[test]
    fn descriptors() {
        run("uvc_descriptors", super::descriptors);
    }

    #[test]
    fn probe_blocks() {
        run("uvc_probe", super::probe);
    }
}
