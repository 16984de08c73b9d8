//! Two frame headers field by field, by the table of fields that the bus makes: none can be forgotten.

use crate::msgs::frame_info::{self, Extra};
use depthrig_bus::{FIELDS, Field, FrameFlags, FrameHeader, HEADER_SIZE};

/// Fields that a replay or a recorder gives anew (`daemon/src/replay.rs`): numbers on a channel begin at 1 and
/// have no gap, `captured` follows from them, and sets are counted by each recording. The flag `replayed` is
/// passage too. Every time in a header is the original one and therefore identity.
const PASSAGE: [&str; 3] = ["sequence", "set_id", "captured"];

/// Bytes of the encapsulation before the header's bytes in a `FrameInfo` message.
const BEFORE: usize = 4;

/// Compares headers; the buffers are reused.
pub(super) struct Compare {
    strict: bool,
    bytes: [Vec<u8>; 2],
}

impl Compare {
    pub(super) fn new(strict: bool) -> Self {
        Self { strict, bytes: [Vec::new(), Vec::new()] }
    }

    /// Name and both values of each field that differs.
    pub(super) fn differing(
        &mut self,
        a: &FrameHeader,
        b: &FrameHeader,
    ) -> Vec<(&'static str, String, String)> {
        for (header, bytes) in [a, b].into_iter().zip(&mut self.bytes) {
            let mut header = *header;
            if !self.strict {
                header.flags &= !FrameFlags::REPLAYED.0;
            }
            bytes.clear();
            // The message begins with the bytes of the header, in the order of `FIELDS`.
            frame_info::write(bytes, &header, &Extra { stamp_utc_ns: 0, frame_id: "", codec: "" });
        }
        let [x, y] = &self.bytes;
        if x[..BEFORE + HEADER_SIZE] == y[..BEFORE + HEADER_SIZE] {
            return Vec::new();
        }
        let differs = |f: &&Field| {
            let at = BEFORE + f.offset;
            x[at..at + f.bytes()] != y[at..at + f.bytes()] && (self.strict || !PASSAGE.contains(&f.name))
        };
        let fields = FIELDS.iter().filter(differs);
        fields.map(|f| (f.name, value(f, &x[BEFORE..]), value(f, &y[BEFORE..]))).collect()
    }
}

/// A field's value in words: text as text, one number as it is, several as a list.
fn value(f: &Field, header: &[u8]) -> String {
    let bytes = &header[f.offset..f.offset + f.bytes()];
    if f.kind == "u8" {
        let text: Vec<u8> = bytes.iter().copied().take_while(|b| *b != 0).collect();
        return format!("{:?}", String::from_utf8_lossy(&text));
    }
    let each = bytes.chunks_exact(f.bytes() / f.count).map(|b| number(f.kind, b));
    let values: Vec<_> = each.collect();
    if f.count == 1 { values.concat() } else { format!("[{}]", values.join(", ")) }
}

fn number(kind: &str, bytes: &[u8]) -> String {
    let mut eight = [0; 8];
    eight[..bytes.len()].copy_from_slice(bytes);
    let bits = u64::from_le_bytes(eight);
    match kind {
        "f64" => f64::from_bits(bits).to_string(),
        "f32" => f32::from_bits(bits as u32).to_string(),
        "i64" => (bits as i64).to_string(),
        _ => bits.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::frame_info::tests::{any_header, memory};
    use proptest::prelude::*;

    #[test]
    fn values_read_well() {
        let mut a = FrameHeader { gain: 1.5, ..FrameHeader::default() };
        a.set_device("D435", "7");
        let mut b = FrameHeader { dropped: [0, 3, 0, 0, 0, 0, 0, 0], ..a };
        b.capture_time_ns = -4;
        b.temperature_c = 20.0;
        b.set_device("D435i", "7");
        let found = Compare::new(false).differing(&a, &b);
        let found: Vec<_> = found.iter().map(|(f, x, y)| (*f, x.as_str(), y.as_str())).collect();
        assert_eq!(
            found,
            [
                ("capture_time_ns", "0", "-4"),
                ("dropped", "[0, 0, 0, 0, 0, 0, 0, 0]", "[0, 3, 0, 0, 0, 0, 0, 0]"),
                ("temperature_c", "NaN", "20"),
                ("model", "\"D435\"", "\"D435i\""),
            ]
        );
    }

    #[test]
    fn what_a_replay_changes_is_passage() {
        let a = FrameHeader { flags: FrameFlags::SYNTHETIC.0, ..FrameHeader::default() };
        let replayed = a.flags | FrameFlags::REPLAYED.0;
        let b = FrameHeader { sequence: 1, captured: 3, set_id: 9, flags: replayed, ..a };
        assert_eq!(Compare::new(false).differing(&a, &b), []);
        let names: Vec<_> = Compare::new(true).differing(&a, &b).into_iter().map(|d| d.0).collect();
        assert_eq!(names, ["sequence", "set_id", "captured", "flags"]);
        let late = FrameHeader { flags: replayed | FrameFlags::LATE.0, ..a };
        assert_eq!(Compare::new(false).differing(&a, &late).len(), 1, "other flags are identity");
    }

    proptest! {
        /// Whichever byte differs, the field that holds it is named, and no other.
        #[test]
        fn one_changed_byte_is_one_field(h in any_header(), at in 0..HEADER_SIZE, flip in 1u8..) {
            let mut bytes = memory(&h);
            bytes[at] ^= flip;
            let mut message = vec![0, 1, 0, 0];
            message.extend(bytes);
            message.extend([0; 8 + 8 + 8]); // an empty stamp and two texts without a character
            let (changed, _) = frame_info::read(&message).unwrap();
            let names: Vec<_> = Compare::new(true).differing(&h, &changed).into_iter().map(|d| d.0).collect();
            let holds = |f: &&Field| (f.offset..f.offset + f.bytes()).contains(&at);
            let expected: Vec<_> = FIELDS.iter().filter(holds).map(|f| f.name).collect();
            prop_assert_eq!(expected.len(), 1);
            prop_assert_eq!(names, expected);
        }
    }
}
