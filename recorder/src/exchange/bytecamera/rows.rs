//! A line of `frames.csv`: one frame of one set with every number of its header, or a frame that the set has not.

use depthrig_bus::FrameHeader;
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

/// The first line.
pub(super) fn head() -> String {
    let mut line = OF_SET.to_owned();
    macro_rules! names {
        ($($field:ident),*) => { $( line.push(','); line.push_str(stringify!($field)); )* };
    }
    header_fields!(names);
    line.push('\n');
    line
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
        }
        line.push('\n');
        line
    }

    /// Reads a line.
    pub(super) fn parse(line: &str) -> Result<Self, String> {
        let mut texts = line.split(',');
        let mut next = |name: &'static str| {
            texts.next().map(|text| (name, text)).ok_or_else(|| format!("column {name} is missing"))
        };
        let mut row = Self {
            n: number(next("n")?)?,
            set: number(next("set")?)?,
            tick_ns: number(next("tick_ns")?)?,
            set_utc_ns: number(next("set_utc_ns")?)?,
            utc_offset_ns: number(next("utc_offset_ns")?)?,
            spread_ns: number(next("spread_ns")?)?,
            stream: next("stream")?.1.to_owned(),
            file: next("file")?.1.to_owned(),
            header: FrameHeader::default(),
        };
        if row.file.is_empty() {
            return Ok(row);
        }
        let h = &mut row.header;
        let _derived: i64 = number(next("capture_utc_ns")?)?;
        let (name, dropped) = next("dropped")?;
        let mut counts = dropped.split('|');
        for count in &mut h.dropped {
            *count = number((name, counts.next().unwrap_or_default()))?;
        }
        macro_rules! values {
            ($($field:ident),*) => { $( h.$field = number(next(stringify!($field))?)?; )* };
        }
        header_fields!(values);
        Ok(row)
    }
}

fn number<T: std::str::FromStr>((name, text): (&str, &str)) -> Result<T, String> {
    text.parse().map_err(|_| format!("column {name} is \"{text}\", not a number that fits"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::frame_info::tests::any_header;
    use proptest::prelude::*;

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
            let bits = crate::msgs::frame_info::tests::memory;
            prop_assert_eq!(bits(&back.header), bits(&expected));
        }
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
