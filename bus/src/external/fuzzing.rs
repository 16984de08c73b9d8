//! Entry points of the fuzz target `external` for the messages of the hand-shake: passes bytes that another process may
//! have written through the code that reads them. `docs/fuzzing.md` says how to run it.
//! A panic is a finding; so is a violated contract, hence the assertions.

use super::camera::Wanted;
use super::{
    About, ExternalAnswer, ExternalFrame, ExternalOffer, MAX_FRAME_BYTES, MAX_MODES, MAX_STREAMS, MODE_BYTES,
    Mode, Offer, TEXT_BYTES, plain,
};
use crate::HostTime;

/// Decodes bytes as an offer: the header, then the modes. Returns the offer if it is accepted.
///
/// # Panics
/// When an accepted offer has no or too many modes, invalid numbers, or another meaning once re-encoded.
pub fn offer(bytes: &[u8]) -> Option<Offer> {
    let (header, payload) = bytes.split_first_chunk()?;
    let header = plain::offer_of(header);
    let offer = Offer::decode(&header, payload).ok()?;
    assert!((1..=MAX_MODES).contains(&offer.modes.len()) && payload.len() == offer.modes.len() * MODE_BYTES);
    let mut streams: Vec<_> = offer.modes.iter().map(|m| &m.stream).collect();
    streams.sort();
    streams.dedup();
    assert!(streams.len() <= MAX_STREAMS);
    for mode in &offer.modes {
        assert!((1..=MAX_FRAME_BYTES).contains(&mode.frame_bytes()), "{mode:?}");
        let numbers =
            [mode.rate_hz, mode.depth_unit_m, mode.intrinsics.fx, mode.intrinsics.fy, mode.intrinsics.cx];
        assert!(numbers.iter().chain(&mode.intrinsics.coeffs).all(|n| n.is_finite()), "{mode:?}");
        assert!(
            mode.pose.translation_m.iter().chain(&mode.pose.rotation_xyzw).all(|n| n.is_finite()),
            "{mode:?}"
        );
    }
    let records: Vec<u8> = offer.modes.iter().flat_map(mode_bytes).collect();
    let mut again =
        ExternalOffer { instance: 1, modes: offer.modes.len() as u32, ..ExternalOffer::default() };
    offer.about.encode(&mut again);
    let again = Offer::decode(&again, &records);
    assert_eq!(again.as_ref().ok(), Some(&offer), "what was taken is not taken again: {again:?}");
    Some(offer)
}

/// Decodes bytes as an answer: the process's number of modes in one byte, the header, the payload. Returns the number
/// of modes to run plus 1; 0 if the bytes are not an answer.
///
/// # Panics
/// When the answer runs a mode that the process does not have, or a refusal is longer than its field.
pub fn answer(bytes: &[u8]) -> u64 {
    let Some((modes, rest)) = bytes.split_first() else { return 0 };
    let Some((header, payload)) = rest.split_first_chunk() else { return 0 };
    let mut header = plain::answer_of(header);
    let modes = usize::from(*modes).min(MAX_MODES);
    // Outdated answers are skipped: decode it as it is, then with a current time.
    let _ = Wanted::decode(&header, payload, header.instance, modes);
    header.sent_ns = HostTime::now().ns();
    let Some(wanted) = Wanted::decode(&header, payload, header.instance, modes) else { return 0 };
    assert!(wanted.modes.windows(2).all(|w| w[0] < w[1]) && wanted.modes.iter().all(|m| *m < modes));
    assert!(wanted.refusal.as_ref().is_none_or(|r| wanted.modes.is_empty() && r.len() <= TEXT_BYTES * 3));
    1 + wanted.modes.len() as u64
}

/// Decodes bytes as a mode; `None` when they are invalid.
pub fn mode(bytes: &[u8; MODE_BYTES]) -> Option<Mode> {
    Mode::decode(&plain::mode_of(bytes)).ok()
}

/// Decodes arbitrary bytes as a frame header.
pub const fn frame(bytes: &[u8; size_of::<ExternalFrame>()]) -> ExternalFrame {
    plain::frame_of(bytes)
}

/// Encodes `about` and `modes` as the offer that [`offer`] takes, for seeds.
pub fn offer_bytes(about: &About, modes: &[Mode]) -> Vec<u8> {
    let mut header =
        ExternalOffer { instance: 7, number: 1, modes: modes.len() as u32, ..ExternalOffer::default() };
    about.encode(&mut header);
    let mut bytes = plain::bytes_of_offer(&header).to_vec();
    bytes.extend(modes.iter().flat_map(mode_bytes));
    bytes
}

/// Encodes an answer as [`answer`] takes it, for seeds.
pub fn answer_bytes(header: &ExternalAnswer, payload: &[u8]) -> Vec<u8> {
    [&[payload.len() as u8], &plain::bytes_of_answer(header)[..], payload].concat()
}

/// Encodes a mode, for seeds.
pub fn mode_bytes(mode: &Mode) -> [u8; MODE_BYTES] {
    plain::bytes_of_mode(&mode.encode())
}

/// Encodes a frame header, for seeds.
pub const fn frame_bytes(header: &ExternalFrame) -> [u8; size_of::<ExternalFrame>()] {
    plain::bytes_of_frame(header)
}
