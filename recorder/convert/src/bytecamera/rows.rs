//! A line of `frames.csv`: one frame of one set with every number of its header, or a frame that the set has not.

use depthrig_bus::{FrameFlags, FrameHeader};
use std::fmt::Write;

/// One frame of one set.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    /// The number in the names of the set's files.
    pub n: u32,
    pub set: u64,
    pub tick_ns: i64,
    pub set_utc_ns: i64,
    pub utc_offset_ns: i64,
    pub spread_ns: i64,
    /// `camera/stream`.
    pub stream: String,
    /// Below the folder of the session; empty when the set has no frame of the stream.
    pub file: String,
    /// Names, device, format, stride, calibration and set number are not in the row and are left at their defaults.
    pub header: FrameHeader,
}

/// The fields of a header that are columns as they are, under their names.
macro_rules! header_fields {
    ($with:ident) => {
        $with!(
            sequence,
            device_sequence,
            device_time,
            device_tick_ns,
            capture_time_ns,
            capture_uncertainty_ns,
            arrival_time_ns,
            publish_time_ns,
            exposure_ns,
            captured,
            source_sequence,
            depth_unit_m,
            clock_domain,
            clock_epoch,
            flags,
            width,
            height,
            gain,
            temperature_c
        )
    };
}

/// Columns before those of the header.
const OF_SET: &str = "n,set,tick_ns,set_utc_ns,utc_offset_ns,spread_ns,stream,file,capture_utc_ns,dropped";

/// Columns after those of the header: of frames that were made from others, empty for those that were captured. Files of
/// before there were such streams end without them.
const OF_DERIVED: &str = ",source_color_sequence,source_color_capture_time_ns,stage_ns,refiner,refiner_model";

/// The first line.
pub(super) fn head() -> String {
    let mut line = OF_SET.to_owned();
    macro_rules! names {
        ($($field:ident),*) => { $( line.push(','); line.push_str(stringify!($field)); )* };
    }
    header_fields!(names);
    line.push_str(OF_DERIVED);
    line.push('\n');
    line
}

/// Whether this is the first line of a file of ours, of today or of before there were derived streams.
pub(super) fn is_head(line: &str) -> bool {
    let today = head();
    let today = today.trim_end();
    line == today || today.strip_suffix(OF_DERIVED) == Some(line)
}

/// A field of text as a column: what would end a column is replaced.
fn plain(text: &str) -> String {
    text.trim().replace(|c: char| c == ',' || c == '"' || c.is_control(), "_")
}

impl Row {
    /// The line, with its end. No text in it can hold a comma.
    pub(super) fn text(&self) -> String {
        let h = &self.header;
        let mut line = format!(
            "{},{},{},{},{},{},{},{}",
            self.n,
            self.set,
            self.tick_ns,
            self.set_utc_ns,
            self.utc_offset_ns,
            self.spread_ns,
            self.stream,
            self.file
        );
        if !self.file.is_empty() {
            let dropped = h.dropped.map(|n| n.to_string()).join("|");
            let utc = h.capture_time_ns.saturating_add(self.utc_offset_ns);
            // Writing to a string does not fail.
            let _ = write!(line, ",{utc},{dropped}");
            macro_rules! values {
                ($($field:ident),*) => { $( let _ = write!(line, ",{}", h.$field); )* };
            }
            header_fields!(values);
            if h.has(FrameFlags::DERIVED) {
                let steps = h.stage_ns.map(|n| n.to_string()).join("|");
                let engine = plain(h.refiner());
                let model = plain(h.refiner_model());
                let _ = write!(
                    line,
                    ",{},{},{steps},{engine},{model}",
                    h.source_color_sequence, h.source_color_capture_time_ns
                );
            } else {
                line.push_str(",,,,,");
            }
        }
        line.push('\n');
        line
    }

    /// Reads a line.
    pub(super) fn parse(line: &str) -> Result<Self, String> {
        let mut texts = line.split(',');
        let mut next = |name: &'static str| {
            texts.next().map(|text| Column { name, text }).ok_or_else(|| format!("column {name} is missing"))
        };
        let mut row = Self {
            n: number(next("n")?)?,
            set: number(next("set")?)?,
            tick_ns: number(next("tick_ns")?)?,
            set_utc_ns: number(next("set_utc_ns")?)?,
            utc_offset_ns: number(next("utc_offset_ns")?)?,
            spread_ns: number(next("spread_ns")?)?,
            stream: next("stream")?.text.to_owned(),
            file: next("file")?.text.to_owned(),
            header: FrameHeader::default(),
        };
        if row.file.is_empty() {
            return Ok(row);
        }
        let h = &mut row.header;
        let _derived: i64 = number(next("capture_utc_ns")?)?;
        let dropped = next("dropped")?;
        let mut counts = dropped.text.split('|');
        for count in &mut h.dropped {
            *count = number(Column { text: counts.next().unwrap_or_default(), ..dropped })?;
        }
        macro_rules! values {
            ($($field:ident),*) => { $( h.$field = number(next(stringify!($field))?)?; )* };
        }
        header_fields!(values);
        let derived = OF_DERIVED.trim_start_matches(',').split(',').map(|name| (name, texts.next()));
        let derived: Vec<_> =
            derived.map(|(name, text)| Column { name, text: text.unwrap_or_default() }).collect();
        if let [color, time, steps, engine, model] = derived[..]
            && !color.text.is_empty()
        {
            h.source_color_sequence = number(color)?;
            h.source_color_capture_time_ns = number(time)?;
            let mut counts = steps.text.split('|');
            for step in &mut h.stage_ns {
                *step = number(Column { text: counts.next().unwrap_or_default(), ..steps })?;
            }
            h.set_refiner(engine.text, model.text);
        }
        Ok(row)
    }
}

/// A value of a line, with the name of its column.
#[derive(Clone, Copy)]
struct Column<'a> {
    name: &'a str,
    text: &'a str,
}

fn number<T: std::str::FromStr>(column: Column<'_>) -> Result<T, String> {
    let Column { name, text } = column;
    text.parse().map_err(|_| format!("column {name} is \"{text}\", not a number that fits"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_recorder::testing::{HEADER_BYTES, header_bytes, header_of};
    use proptest::prelude::*;

    /// A header of any bits at all.
    fn any_header() -> impl Strategy<Value = FrameHeader> {
        proptest::collection::vec(any::<u8>(), HEADER_BYTES).prop_map(|b| header_of(b.try_into().unwrap()))
    }

    proptest! {
        /// Whatever is in a header, the fields that have no other place come back.
        #[test]
        fn a_row_keeps_every_number(mut header in any_header(), n: u32, set: u64, times: [i64; 4]) {
            // One NaN is as good as another, and text has only one.
            for v in [&mut header.gain, &mut header.temperature_c] {
                if v.is_nan() { *v = f32::NAN; }
            }
            for v in [&mut header.device_tick_ns, &mut header.depth_unit_m] {
                if v.is_nan() { *v = f64::NAN; }
            }
            let row = Row {
                n, set, tick_ns: times[0], set_utc_ns: times[1], utc_offset_ns: times[2], spread_ns: times[3],
                stream: "a/b".into(), file: "camera_a/depth_1.png".into(), header,
            };
            let text = row.text();
            prop_assert_eq!(text.matches(',').count(), head().matches(',').count());
            let back = Row::parse(text.trim_end()).unwrap();
            prop_assert_eq!(back.text(), text);
            let mut expected = FrameHeader::default();
            macro_rules! copy { ($($f:ident),*) => { $( expected.$f = header.$f; )* }; }
            header_fields!(copy);
            expected.dropped = header.dropped;
            if header.has(FrameFlags::DERIVED) {
                expected.source_color_sequence = header.source_color_sequence;
                expected.source_color_capture_time_ns = header.source_color_capture_time_ns;
                expected.stage_ns = header.stage_ns;
                expected.set_refiner(&plain(header.refiner()), &plain(header.refiner_model()));
            }
            prop_assert_eq!(header_bytes(&back.header), header_bytes(&expected));
        }
    }

    #[test]
    fn heads_of_today_and_of_before_are_known() {
        let today = head();
        let before = today.trim_end().strip_suffix(OF_DERIVED).unwrap();
        assert!(before.ends_with(",temperature_c"), "{before}");
        assert!(is_head(today.trim_end()) && is_head(before));
        assert!(!is_head("") && !is_head(OF_SET) && !is_head(&format!("{before},")));
    }

    #[test]
    fn what_made_a_derived_frame_comes_back_and_rows_of_before_have_none() {
        let mut header =
            FrameHeader { flags: FrameFlags::DERIVED.0, source_color_sequence: 7, ..FrameHeader::default() };
        header.set_refiner("onnxruntime 1.31.1 cpu fp32", "cdm-d435@1f2e3d4c");
        let file = "camera_a/depth_refined_1.png".to_owned();
        let n = 1;
        let set = 2;
        let stream = "a/depth_refined".to_owned();
        let row =
            Row { n, set, tick_ns: 0, set_utc_ns: 0, utc_offset_ns: 0, spread_ns: 0, stream, file, header };
        let text = row.text();
        let back = Row::parse(text.trim_end()).unwrap().header;
        assert_eq!((back.refiner(), back.refiner_model()), (header.refiner(), header.refiner_model()));
        assert_eq!(back.source_color_sequence, 7);
        // As it was written before there were derived frames.
        let old = text.rsplitn(6, ',').last().unwrap();
        assert_eq!(Row::parse(old).unwrap().header.source_color_sequence, 0);
    }

    #[test]
    fn a_frame_that_is_not_there_is_a_short_row() {
        let line = "7,9,1,2,3,4,a/b,\n";
        let row = Row::parse(line.trim_end()).unwrap();
        assert_eq!((row.n, row.set, row.text().as_str()), (7, 9, line));
        assert!(Row::parse("7,9").unwrap_err().contains("column tick_ns is missing"));
        assert!(Row::parse("7,x,1,2,3,4,a/b,").unwrap_err().contains("column set is \"x\""));
    }
}
