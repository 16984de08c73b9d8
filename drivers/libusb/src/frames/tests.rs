use super::*;
use depthrig_usb::uvc::payload::PayloadHeader;
use proptest::prelude::*;

const FRAME: usize = 100;

/// A frame as it came: number, bytes, length of its header, damaged.
type Seen = (u64, Vec<u8>, Option<usize>, bool);

fn layout(payload_bytes: usize) -> Layout {
    Layout { frame_bytes: FRAME, fixed: true, payload_bytes }
}

fn payload(id: usize, flags: u8, data: &[u8]) -> Vec<u8> {
    let mut bytes = PayloadHeader::build(flags | (id % 2) as u8, Some(7), None, &[]).unwrap();
    bytes.extend_from_slice(data);
    bytes
}

fn image(n: usize) -> Vec<u8> {
    (0..FRAME).map(|i| (i * 7 + n * 31) as u8).collect()
}

/// Feeds payloads, cut into transfers of `transfer` bytes.
fn run(layout: Layout, transfer: usize, payloads: &[Vec<u8>]) -> (Vec<Seen>, u64) {
    let mut assembler = Assembler::new(layout);
    let mut seen = Vec::new();
    for payload in payloads {
        let mut rest = payload.as_slice();
        loop {
            let (now, later) = rest.split_at(rest.len().min(transfer));
            let short = now.len() < transfer;
            assembler.take(now, short, &mut |f| {
                seen.push((f.sequence, f.bytes.to_vec(), f.header.map(<[u8]>::len), f.damaged));
            });
            rest = later;
            if short || (rest.is_empty() && payload.len() >= layout.payload_bytes) {
                break;
            }
        }
    }
    (seen, assembler.copied())
}

fn good(n: usize) -> Seen {
    (n as u64, image(n), Some(6), false)
}

#[test]
fn one_payload_is_one_frame_and_is_not_copied() {
    let payloads: Vec<_> = (0..4).map(|n| payload(n, Flags::END_OF_FRAME, &image(n))).collect();
    let (seen, copied) = run(layout(FRAME + 20), 256, &payloads);
    assert_eq!(seen, (0..4).map(good).collect::<Vec<_>>());
    assert_eq!(copied, 0);
}

#[test]
fn a_whole_frame_needs_no_end_flag() {
    let payloads: Vec<_> = (0..3).map(|n| payload(n, 0, &image(n))).collect();
    let (seen, _) = run(layout(FRAME + 20), 256, &payloads);
    assert_eq!(seen, (0..3).map(good).collect::<Vec<_>>());
}

#[test]
fn the_same_identifier_twice_is_a_gap() {
    let sent = [0, 1, 2, 4, 5, 7];
    let payloads: Vec<_> = sent.iter().map(|&n| payload(n, Flags::END_OF_FRAME, &image(n))).collect();
    let (seen, _) = run(layout(FRAME + 20), 256, &payloads);
    assert_eq!(seen, sent.map(good));
    // A device that never changes it shows no gaps.
    let payloads: Vec<_> = (0..5).map(|n| payload(0, Flags::END_OF_FRAME, &image(n))).collect();
    let (seen, _) = run(layout(FRAME + 20), 256, &payloads);
    assert_eq!(seen, (0..5).map(good).collect::<Vec<_>>());
}

#[test]
fn a_flagged_frame_is_damaged_and_a_short_one_short() {
    let payloads = [
        payload(0, Flags::END_OF_FRAME | Flags::ERROR, &image(0)),
        payload(1, Flags::END_OF_FRAME, &image(1)[..40]),
        payload(2, Flags::END_OF_FRAME, &[image(2), vec![1; 9]].concat()),
        payload(3, Flags::END_OF_FRAME, &image(3)),
    ];
    let (seen, _) = run(layout(200), 256, &payloads);
    assert_eq!(seen[0], (0, image(0), Some(6), true));
    assert_eq!(seen[1], (1, image(1)[..40].to_vec(), Some(6), false));
    assert_eq!(
        seen[2],
        (2, [image(2), vec![1]].concat(), Some(6), false),
        "too long, by one byte that is kept"
    );
    assert_eq!(seen[3], good(3));
}

#[test]
fn a_frame_over_several_payloads_is_put_together() {
    let mut payloads = Vec::new();
    for n in 0..3 {
        let image = image(n);
        payloads.push(payload(n, 0, &image[..30]));
        payloads.push(payload(n, 0, &image[30..31]));
        payloads.push(payload(n, 0, &image[31..]));
        payloads.push(payload(n, Flags::END_OF_FRAME, &[])); // behind the last byte: it says nothing new
    }
    let (seen, copied) = run(layout(90), 128, &payloads);
    assert_eq!(seen, (0..3).map(good).collect::<Vec<_>>());
    assert_eq!(copied, 3 * FRAME as u64);
}

#[test]
fn a_frame_that_never_ends_is_handed_on_when_the_next_begins() {
    let payloads = [payload(0, 0, &image(0)[..60]), payload(1, Flags::END_OF_FRAME, &image(1))];
    let (seen, _) = run(layout(FRAME + 20), 256, &payloads);
    assert_eq!(seen, [(0, image(0)[..60].to_vec(), Some(6), false), good(1)]);
}

#[test]
fn a_broken_header_or_transfer_costs_one_frame() {
    let payloads = [
        payload(0, Flags::END_OF_FRAME, &image(0)),
        payload(1, Flags::END_OF_FRAME, &image(1)),
        [&[1, 0][..], &image(2)].concat(),
        payload(3, Flags::END_OF_FRAME, &image(3)),
    ];
    let (seen, _) = run(layout(FRAME + 20), 256, &payloads);
    assert_eq!(seen, [good(0), good(1), (2, vec![], None, true), good(3)]);

    let mut assembler = Assembler::new(layout(FRAME + 20));
    let mut seen = Vec::new();
    let mut note = |f: &Assembled<'_>| seen.push((f.sequence, f.bytes.len(), f.damaged));
    assembler.take(&payload(0, 0, &image(0)[..50]), true, &mut note);
    assembler.broken(&mut note);
    assembler.broken(&mut note);
    assembler.take(&payload(0, Flags::END_OF_FRAME, &image(2)), true, &mut note);
    assembler.take(&payload(1, 0, &image(3)[..9]), true, &mut note);
    assembler.restart(&mut note);
    assembler.take(&payload(1, Flags::END_OF_FRAME, &image(4)), true, &mut note);
    assert_eq!(seen, [(0, 50, true), (1, 0, true), (2, 100, false), (3, 9, true), (4, 100, false)]);
}

#[test]
fn a_broken_payload_over_several_transfers_is_passed_over_whole() {
    let mut wrong = payload(1, Flags::END_OF_FRAME, &image(1));
    wrong[0] = 0;
    let payloads =
        [payload(0, Flags::END_OF_FRAME, &image(0)), wrong, payload(2, Flags::END_OF_FRAME, &image(2))];
    let (seen, _) = run(layout(FRAME + 20), 32, &payloads);
    assert_eq!(seen, [good(0), (1, vec![], None, true), good(2)]);
}

#[test]
fn an_error_flag_in_any_payload_damages_the_frame() {
    let payloads = [
        payload(0, 0, &image(0)[..30]),
        payload(0, Flags::ERROR, &image(0)[30..60]),
        payload(0, Flags::END_OF_FRAME, &image(0)[60..]),
    ];
    let (seen, _) = run(layout(90), 128, &payloads);
    assert_eq!(seen, [(0, image(0), Some(6), true)]);
}

#[test]
fn a_restart_forgets_the_payload_that_was_under_way() {
    let mut assembler = Assembler::new(layout(FRAME + 20));
    let mut seen = Vec::new();
    let mut note = |f: &Assembled<'_>| seen.push((f.bytes.len(), f.damaged));
    assembler.take(&payload(0, 0, &image(0))[..32], false, &mut note);
    assembler.restart(&mut note);
    assembler.take(&payload(0, Flags::END_OF_FRAME, &image(1)), true, &mut note);
    assert_eq!(seen, [(26, true), (100, false)]);
}

proptest! {
    /// However a device cuts its frames into payloads, and however those fall into transfers, they come out whole.
    #[test]
    fn any_split_gives_the_same_frames(
        cuts in proptest::collection::vec(proptest::collection::vec(0..=FRAME, 0..5), 1..6),
        transfer in 8_usize..140,
        end_flag in any::<bool>(),
        alone in any::<bool>(),
    ) {
        let mut payloads = Vec::new();
        let mut longest = 0;
        for (n, cuts) in cuts.iter().enumerate() {
            let mut at: Vec<_> = cuts.clone();
            at.extend([0, FRAME]);
            at.sort_unstable();
            at.dedup();
            for pair in at.windows(2) {
                let last = pair[1] == FRAME;
                let flags = if last && end_flag && !alone { Flags::END_OF_FRAME } else { 0 };
                let p = payload(n, flags, &image(n)[pair[0]..pair[1]]);
                longest = longest.max(p.len());
                payloads.push(p);
            }
            if alone {
                payloads.push(payload(n, Flags::END_OF_FRAME, &[]));
            }
        }
        let (seen, _) = run(layout(longest), transfer, &payloads);
        prop_assert_eq!(seen, (0..cuts.len()).map(good).collect::<Vec<_>>());
    }

    /// Whatever a device sends, no frame is longer than it may be, and numbers rise.
    #[test]
    fn any_bytes_give_frames_within_bounds(
        transfers in proptest::collection::vec((proptest::collection::vec(any::<u8>(), 0..150), any::<bool>()), 0..40),
        fixed in any::<bool>(),
    ) {
        let mut assembler = Assembler::new(Layout { fixed, ..layout(120) });
        let mut last = None;
        for (bytes, short) in &transfers {
            assembler.take(bytes, *short, &mut |f| {
                assert!(f.bytes.len() <= FRAME + 1);
                assert!(last < Some(f.sequence), "{last:?} then {}", f.sequence);
                last = Some(f.sequence);
            });
        }
    }
}
