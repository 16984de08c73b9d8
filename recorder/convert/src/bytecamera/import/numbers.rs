//! Sets without a `frames.csv`: the same number is the same set, and times follow from the numbers.

use super::{ByteCameraImport, FRAMES_FILE, List};
use depthrig_bus::{ClockDomain, DropReason, FrameFlags, FrameHeader, HostTime, UtcPair};
use depthrig_recorder::{RecordFrame, RecordSet, Result};
use std::collections::BTreeSet;
use time::{Date, Month, PrimitiveDateTime, Time};

/// Rate at which the published dataset was recorded, Hz.
const USUAL_RATE_HZ: f64 = 5.0;

impl ByteCameraImport {
    /// Sets from the numbers of the files.
    pub(super) fn by_numbers(&mut self) {
        let numbers: BTreeSet<u32> = self.streams.iter().flat_map(|s| s.files.keys().copied()).collect();
        let rate = self.options.rate_hz.unwrap_or(USUAL_RATE_HZ);
        let how = if self.options.rate_hz.is_some() { "as given" } else { "assumed" };
        self.state(format!("there is no {FRAMES_FILE}: times follow from the numbers of the files at {rate} Hz, {how}; the same number is the same set"));
        let folder = self.dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let start = start_of(&folder);
        self.state(match start {
            Some(_) => format!("the start is the folder's name {folder}, taken as UTC"),
            None => {
                format!("the folder's name {folder} is not a date YYYYMMDD_HHMM: the start is 1970-01-01")
            }
        });
        let numbers: Vec<u32> = numbers.into_iter().collect();
        let holes = numbers.windows(2).map(|w| u64::from(w[1] - w[0] - 1)).sum::<u64>();
        if holes > 0 {
            self.facts.lost += holes;
            self.facts
                .problems
                .push(format!("{holes} numbers between the first and the last are in no folder"));
        }
        for s in &mut self.streams {
            s.record.rate_hz = rate;
        }
        self.tell_holes(&numbers);
        if self.session.started_utc_ns == 0 {
            self.session.started_utc_ns = start.unwrap_or(0);
        }
        let period_ns = (1e9 / rate).round() as i64;
        self.list = List::Numbers { numbers, at: 0, start_utc_ns: start.unwrap_or(0), period_ns };
    }

    /// States of each stream how many of the numbers it has not.
    fn tell_holes(&mut self, numbers: &[u32]) {
        for i in 0..self.streams.len() {
            let s = &self.streams[i];
            let missing = numbers.len() - s.files.len();
            if missing > 0 {
                let first = numbers.iter().find(|n| !s.files.contains_key(n));
                let what = format!(
                    "{}: {missing} of {} sets have no file {}/{}_N.{}, the first is number {}",
                    s.record.id,
                    numbers.len(),
                    s.folder,
                    s.prefix,
                    s.ending,
                    first.unwrap_or(&0)
                );
                self.state(what);
            }
        }
    }

    /// The next set, put together by the numbers of the files.
    pub(super) fn set_of_number(&mut self) -> Result<Option<RecordSet>> {
        let List::Numbers { numbers, at, start_utc_ns, period_ns } = &mut self.list else { return Ok(None) };
        let (Some(n), Some(first)) = (numbers.get(*at).copied(), numbers.first()) else { return Ok(None) };
        *at += 1;
        let tick = i64::from(n - first) * *period_ns;
        let period = *period_ns;
        let start = *start_utc_ns;
        let mut set = RecordSet {
            id: u64::from(n) + 1,
            tick: HostTime::from_ns(tick),
            utc: UtcPair { utc_ns: start, ..UtcPair::default() },
            frames: Vec::new(),
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        };
        for i in 0..self.streams.len() {
            if !self.streams[i].files.contains_key(&n) {
                continue;
            }
            self.done += 1;
            let read = self.image(&self.streams[i], n)?.and_then(|p| self.streams[i].check(p));
            let s = &mut self.streams[i];
            s.dropped.add(DropReason::DeviceGap, s.last.map_or(0, |last| u64::from(n - last - 1)));
            s.last = Some(n);
            match read {
                Ok(image) => {
                    s.sequence += 1;
                    let mut header = FrameHeader {
                        sequence: s.sequence,
                        device_sequence: u64::from(n),
                        device_time: u64::from(n),
                        device_tick_ns: period as f64,
                        capture_time_ns: tick,
                        capture_uncertainty_ns: period.unsigned_abs(),
                        arrival_time_ns: tick,
                        publish_time_ns: tick,
                        captured: s.sequence + s.dropped.total(),
                        dropped: s.dropped.0,
                        depth_unit_m: s.record.depth_unit_m,
                        clock_domain: ClockDomain::Arrival as u32,
                        flags: FrameFlags::TIME_UNCERTAIN.0,
                        ..FrameHeader::default()
                    };
                    s.fill(&mut header, &self.session.rig, &image);
                    s.last_header = Some(header);
                    self.alpha_dropped += u64::from(image.alpha_dropped);
                    set.frames.push(RecordFrame { stream: i, header, pixels: Box::new(image.pixels) });
                }
                Err(why) => {
                    s.dropped.add(DropReason::Incomplete, 1);
                    let path = s.path(n);
                    self.facts.lose(format!("{path}: {why}"));
                }
            }
        }
        self.close(&mut set);
        Ok(Some(set))
    }
}

/// UTC of `YYYYMMDD_HHMM`, nanoseconds since 1970.
fn start_of(folder: &str) -> Option<i64> {
    let text = folder.get(..13)?;
    let number = |at: std::ops::Range<usize>| text.get(at)?.parse::<u16>().ok();
    let month = Month::try_from(u8::try_from(number(4..6)?).ok()?).ok()?;
    let date =
        Date::from_calendar_date(i32::from(number(0..4)?), month, u8::try_from(number(6..8)?).ok()?).ok()?;
    let time =
        Time::from_hms(u8::try_from(number(9..11)?).ok()?, u8::try_from(number(11..13)?).ok()?, 0).ok()?;
    i64::try_from(PrimitiveDateTime::new(date, time).assume_utc().unix_timestamp_nanos()).ok()
}
