//! Entry point of the fuzz target `uvc_payload`: a payload header, and transfers of a stream, with any bytes.

use super::frames::{Assembler, Layout};
use depthrig_usb::uvc::payload::PayloadHeader;

const FRAME: usize = 64;

/// A payload header, and then the same bytes as transfers of a stream; the number of frames.
///
/// # Panics
/// When a header is not as long as its parts, or a frame has more bytes than it may have, or frames do not rise.
pub fn payload(bytes: &[u8]) -> u64 {
    if let Ok(header) = PayloadHeader::parse(bytes) {
        let times = 4 * usize::from(header.pts.is_some()) + 6 * usize::from(header.source_clock.is_some());
        assert_eq!(header.bytes.len(), 2 + times + header.vendor.len());
        let built = PayloadHeader::build(header.flags.0, header.pts, header.source_clock, header.vendor);
        assert_eq!(built.map(|b| b.len()), Some(header.bytes.len()));
    }
    transfers(bytes)
}

/// Feeds transfers to a stream's assembler: the first byte says what frames are like, then each transfer is a byte of
/// length, one with a flag, and its bytes. The number of frames that came of it.
fn transfers(bytes: &[u8]) -> u64 {
    let Some((&kind, mut rest)) = bytes.split_first() else { return 0 };
    let layout =
        Layout { frame_bytes: FRAME, fixed: kind & 1 == 1, payload_bytes: usize::from(kind >> 1) + 12 };
    let mut assembler = Assembler::new(layout);
    let mut frames = 0;
    let mut last = None;
    while let [length, flags, tail @ ..] = rest {
        let (transfer, next) = tail.split_at(usize::from(*length).min(tail.len()));
        rest = next;
        let mut each = |frame: &super::frames::Assembled<'_>| {
            assert!(frame.bytes.len() <= FRAME + 1, "{} bytes", frame.bytes.len());
            assert!(last < Some(frame.sequence), "{last:?}, then {}", frame.sequence);
            assert!(frame.header.is_none_or(|h| h.len() >= 2));
            last = Some(frame.sequence);
            frames += 1;
        };
        match flags & 0x0F {
            0x0E => assembler.broken(&mut each),
            0x0F => assembler.restart(&mut each),
            _ => assembler.take(transfer, flags & 0x10 != 0, &mut each),
        }
    }
    frames
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_corpus_passes() {
        depthrig_corpus::run("uvc_payload", super::payload);
    }
}
