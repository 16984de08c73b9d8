//! What the fuzz target `external` calls for the messages of the hand-shake: bytes that another process may have written,
//! through the code that reads them. `docs/fuzzing.md` says how it is run.
//!
//! A panic is a finding; so is a broken promise, which is why there are assertions here.

use super::camera::Wanted;
use super::{
    About, ExternalAnswer, ExternalFrame, ExternalOffer, MAX_FRAME_BYTES, MAX_MODES, MAX_STREAMS, MODE_BYTES,
    Mode, Offer, TEXT_BYTES, plain,
};
use crate::HostTime;

/// Bytes as an offer: its header, and what comes behind it as its modes. What is offered, if it is taken.
///
/// # Panics
/// When an offer is taken that has no or too many modes, numbers that cannot be, or another meaning when it is written
/// again.
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

/// Bytes as an answer: a byte that says how many modes the process has, the header, the payload. How many modes are to
/// run, and 1; 0 for what is no answer.
///
/// # Panics
/// When a mode is to run that the process does not have, or a refusal is longer than its field.
pub fn answer(bytes: &[u8]) -> u64 {
    let Some((modes, rest)) = bytes.split_first() else { return 0 };
    let Some((header, payload)) = rest.split_first_chunk() else { return 0 };
    let mut header = plain::answer_of(header);
    let modes = usize::from(*modes).min(MAX_MODES);
    // One that is of before is passed over, so it is made one of now; as it came it is read too.
    let _ = Wanted::decode(&header, payload, header.instance, modes);
    header.sent_ns = HostTime::now().ns();
    let Some(wanted) = Wanted::decode(&header, payload, header.instance, modes) else { return 0 };
    assert!(wanted.modes.windows(2).all(|w| w[0] < w[1]) && wanted.modes.iter().all(|m| *m < modes));
    assert!(wanted.refusal.as_ref().is_none_or(|r| wanted.modes.is_empty() && r.len() <= TEXT_BYTES * 3));
    1 + wanted.modes.len() as u64
}

/// Bytes as a mode; `None` when it cannot be one.
pub fn mode(bytes: &[u8; MODE_BYTES]) -> Option<Mode> {
    Mode::decode(&plain::mode_of(bytes)).ok()
}

/// Bytes as a frame's header, whatever they are.
pub const fn frame(bytes: &[u8; size_of::<ExternalFrame>()]) -> ExternalFrame {
    plain::frame_of(bytes)
}

/// What `about` and `modes` are on the bus, for seeds: an offer as [`offer`] takes it.
pub fn offer_bytes(about: &About, modes: &[Mode]) -> Vec<u8> {
    let mut header =
        ExternalOffer { instance: 7, number: 1, modes: modes.len() as u32, ..ExternalOffer::default() };
    about.encode(&mut header);
    let mut bytes = plain::bytes_of_offer(&header).to_vec();
    bytes.extend(modes.iter().flat_map(mode_bytes));
    bytes
}

/// An answer as [`answer`] takes it, for seeds.
pub fn answer_bytes(header: &ExternalAnswer, payload: &[u8]) -> Vec<u8> {
    [&[payload.len() as u8], &plain::bytes_of_answer(header)[..], payload].concat()
}

/// What a mode is on the bus, for seeds.
pub fn mode_bytes(mode: &Mode) -> [u8; MODE_BYTES] {
    plain::bytes_of_mode(&mode.encode())
}

/// What a frame's header is on the bus, for seeds.
pub const fn frame_bytes(header: &ExternalFrame) -> [u8; size_of::<ExternalFrame>()] {
    plain::bytes_of_frame(header)
}
