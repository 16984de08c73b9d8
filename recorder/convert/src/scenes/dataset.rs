//! Random scenes as a dataset: each set is one world, seen by one camera.

use crate::{ImportFacts, ImportProgress, Importer};
use depthrig_bus::{ClockDomain, DropCounts, FrameHeader, HostTime, PixelFormat, StreamId, UtcPair};
use depthrig_recorder::{
    Error, ErrorKind, RecordFrame, RecordSet, Result, Session, StreamAccount, StreamRecord,
};
use depthrig_sim::synthetic::scenes::{Generator, TRUTH_UNIT_M, Triplet};

/// Sets in a second: that of the project's datasets.
const RATE_HZ: f64 = 5.0;
const PERIOD_NS: i64 = 200_000_000;
const RIG: &str = "scenes";

/// Makes the sets of a dataset, a world each: colour, measured depth and true depth, all in colour's view.
pub struct SceneSets {
    generator: Generator,
    count: u64,
    done: u64,
    name: String,
    /// Made for the description of the streams.
    first: Option<Triplet>,
    streams: Vec<StreamRecord>,
}

impl SceneSets {
    /// The first `count` samples of `generator` as the dataset `name`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when the generator has several cameras or random lenses: a stream of a dataset has one lens.
    pub fn new(generator: Generator, count: u64, name: String) -> Result<Self> {
        let bad = |why: String| Error::new(ErrorKind::BadInput, why);
        let settings = generator.settings();
        let [camera] = settings.cameras.as_slice() else {
            let cameras = settings.cameras.join(",");
            return Err(bad(format!(
                "each set of a dataset is one world and one camera; name one of {cameras}"
            )));
        };
        if !settings.nominal_lens {
            return Err(bad("a stream of a dataset has one lens; use the nominal one".to_owned()));
        }
        let first = super::sample_of(&generator, 0)?;
        let width = settings.width;
        let height = settings.height;
        let stream = |name: &str, format: PixelFormat, depth_unit_m: f64| {
            let id: Result<StreamId, _> = format!("{camera}/{name}").parse();
            Ok(StreamRecord {
                id: id.map_err(|e| bad(format!("{camera}/{name}: {e}")))?,
                model: first.camera.to_uppercase(),
                serial: String::new(),
                format,
                width,
                height,
                rate_hz: RATE_HZ,
                depth_unit_m,
                calibration: "simulated".to_owned(),
                intrinsics: first.intrinsics,
                pose: depthrig_bus::Pose::IDENTITY,
            })
        };
        let streams = [
            ("color", PixelFormat::Rgb8, 0.0),
            ("depth", PixelFormat::Z16, first.raw_unit_m),
            ("depth_true_color", PixelFormat::Z16, TRUTH_UNIT_M),
        ];
        let streams = streams.into_iter().map(|(n, f, u)| stream(n, f, u)).collect::<Result<_>>()?;
        Ok(Self { generator, count, done: 0, name, first: Some(first), streams })
    }

    fn header(&self, stream: usize) -> FrameHeader {
        let s = &self.streams[stream];
        let number = self.done + 1;
        let at = self.done as i64 * PERIOD_NS;
        let mut header = FrameHeader {
            sequence: number,
            device_sequence: number,
            device_time: at as u64,
            device_tick_ns: 1.0,
            capture_time_ns: at,
            arrival_time_ns: at,
            publish_time_ns: at,
            captured: number,
            depth_unit_m: s.depth_unit_m,
            clock_domain: ClockDomain::Arrival as u32,
            intrinsics: s.intrinsics,
            pose: s.pose,
            ..FrameHeader::default()
        };
        header.set_names(RIG, &s.id);
        header.set_device(&s.model, &s.serial);
        header.set_image(s.format, s.width, s.height);
        header
    }
}

impl Importer for SceneSets {
    fn format(&self) -> &'static str {
        "scenes"
    }

    fn session(&mut self) -> Result<Session> {
        let mut session = Session::new(self.name.clone(), RIG);
        "random worlds".clone_into(&mut session.scene);
        session.started_utc_ns = 0;
        session.streams.clone_from(&self.streams);
        let settings = self.generator.settings();
        let table = toml::Table::from_iter([
            ("format".to_owned(), self.format().into()),
            ("depthrig_version".to_owned(), env!("CARGO_PKG_VERSION").into()),
            ("seed".to_owned(), settings.seed.to_string().into()),
        ]);
        session.extra.insert("import".to_owned(), table.into());
        Ok(session)
    }

    fn next(&mut self) -> Result<Option<RecordSet>> {
        if self.done == self.count {
            return Ok(None);
        }
        let sample = match self.first.take() {
            Some(first) => first,
            None => super::sample_of(&self.generator, self.done)?,
        };
        let units = |pixels: Vec<u16>| pixels.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let images = [sample.color, units(sample.raw), units(sample.truth)];
        let frame =
            |(stream, pixels)| RecordFrame { stream, header: self.header(stream), pixels: Box::new(pixels) };
        let set = RecordSet {
            id: self.done + 1,
            tick: HostTime::from_ns(self.done as i64 * PERIOD_NS),
            utc: UtcPair::default(),
            frames: images.into_iter().enumerate().map(frame).collect(),
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        };
        self.done += 1;
        Ok(Some(set))
    }

    fn progress(&self) -> ImportProgress {
        ImportProgress { done: self.done, total: self.count }
    }

    fn facts(&self) -> ImportFacts {
        let account = |s: &StreamRecord| StreamAccount {
            stream: s.id.clone(),
            captured: self.done,
            delivered: self.done,
            dropped: DropCounts::default(),
        };
        ImportFacts {
            accounts: self.streams.iter().map(account).collect(),
            stated: vec![format!(
                "each set is another world; times are made up: {RATE_HZ} sets a second from 1970-01-01"
            )],
            ..ImportFacts::default()
        }
    }
}
