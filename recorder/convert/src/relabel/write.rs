//! The copy: the sets of the source, each with its refined depth.

use super::refine::{Store, pair, unit_of};
use super::{Camera, Engine, Form};
use crate::{ImportFacts, ImportProgress, Importer};
use depthrig_bus::{DropCounts, PixelFormat, StageStep, UtcPair};
use depthrig_cdm::stage::derived_header;
use depthrig_recorder::codec::{DepthDecoder, DepthShape};
use depthrig_recorder::{
    Dataset, DatasetSet, Derived, Error, ErrorKind, PixelMode, ReadPixels, RecordFrame, RecordSet, Result,
    Session, SetReader, StreamAccount, StreamRecord,
};
use std::path::Path;

pub(super) struct Write<'a> {
    session: Session,
    reader: SetReader,
    number: usize,
    store: Store,
    decoder: DepthDecoder,
    cameras: &'a [Camera],
    engines: &'a [Engine],
    /// Streams of the source.
    streams: usize,
    form: Form,
    written: Vec<u64>,
    /// Number of the last frame of each camera.
    numbers: Vec<u64>,
    epochs: Vec<Option<u32>>,
    facts: ImportFacts,
}

impl<'a> Write<'a> {
    pub(super) fn new(
        dataset: &Dataset,
        out: &Path,
        refined: &Path,
        cameras: &'a [Camera],
        engines: &'a [Engine],
        form: Form,
    ) -> Result<Self> {
        let reader = dataset.set_reader()?;
        let source = dataset.session();
        let mut session = source.clone();
        session.name = out.file_name().unwrap_or_default().to_string_lossy().into_owned();
        session.outcome = None;
        for camera in cameras {
            let color = &source.streams[camera.color];
            let depth = &source.streams[camera.depth];
            session.streams.push(StreamRecord {
                id: camera.id.clone(),
                format: PixelFormat::Z16,
                rate_hz: depth.rate_hz,
                depth_unit_m: if depth.format == PixelFormat::DepthF32 {
                    depthrig_cdm::stage::pixels::UNIT_OF_METRES
                } else {
                    depth.depth_unit_m
                },
                ..color.clone()
            });
        }
        let name = |p: &Path| p.file_name().unwrap_or(p.as_os_str()).to_string_lossy().into_owned();
        let mut from = vec![name(dataset.path())];
        from.extend(dataset.segments().iter().filter(|_| form == Form::Piece).map(|s| name(s)));
        session.derived.push(Derived {
            by: "relabel".to_owned(),
            utc_ns: match form {
                Form::Whole => UtcPair::sample().utc_ns,
                // The same bytes whoever makes it, whenever.
                Form::Piece => reader.times().last().copied().unwrap_or_default(),
            },
            depthrig_version: env!("CARGO_PKG_VERSION").to_owned(),
            from,
            first_utc_ns: reader.times().first().copied().unwrap_or_default(),
            last_utc_ns: reader.times().last().copied().unwrap_or_default(),
            offered_before: 0,
            removed: Vec::new(),
        });
        let mut facts = ImportFacts { accounts: dataset.info()?.accounts, ..ImportFacts::default() };
        reader.problems().iter().for_each(|problem| facts.lose(problem.clone()));
        Ok(Self {
            session,
            reader,
            number: 0,
            store: Store::new(refined),
            decoder: DepthDecoder::new(),
            cameras,
            engines,
            streams: source.streams.len(),
            form,
            written: vec![0; cameras.len()],
            numbers: vec![0; cameras.len()],
            epochs: vec![None; cameras.len()],
            facts,
        })
    }

    /// Frames of each camera so far.
    pub(super) fn written(&self) -> &[u64] {
        &self.written
    }

    /// The refined frame of a camera, if its set has its colour and depth.
    fn refined(&mut self, number: usize, set: &DatasetSet, at: usize) -> Result<Option<RecordFrame>> {
        let camera = &self.cameras[at];
        let Some((color, depth)) = pair(set, camera) else { return Ok(None) };
        let Some(packed) = self.store.take(number, at) else {
            let what =
                format!("{} of set {} is not there although it was refined; begin anew", camera.id, set.id);
            return Err(Error::new(ErrorKind::Corrupt, what));
        };
        let h = &color.header;
        let shape = DepthShape { width: h.width, height: h.height, step: h.width * 2 };
        let mut pixels = Vec::new();
        self.decoder.decode(&packed, shape, &mut pixels)?;
        let description = &self.engines[camera.engine].description;
        let unit_m = unit_of(&depth.header);
        // Times of steps would differ from run to run.
        let steps = [0; StageStep::ALL.len()];
        let mut header =
            derived_header(&color.header, &depth.header, PixelFormat::Z16, unit_m, steps, self.epochs[at]);
        self.epochs[at] = Some(header.clock_epoch);
        header.set_names(&self.session.rig, &camera.id);
        header.set_refiner(&description.engine, &description.model);
        self.written[at] += 1;
        self.numbers[at] = match self.form {
            Form::Whole => self.written[at],
            // Nobody has counted the frames of the pieces before; ids rise from piece to piece.
            Form::Piece => set.id,
        };
        (header.sequence, header.captured) = (self.numbers[at], self.numbers[at]);
        header.dropped = DropCounts::default().0;
        Ok(Some(RecordFrame { stream: self.streams + at, header, pixels: Box::new(pixels) }))
    }
}

impl Importer for Write<'_> {
    fn format(&self) -> &'static str {
        "relabel"
    }

    fn session(&mut self) -> Result<Session> {
        Ok(self.session.clone())
    }

    fn next(&mut self) -> Result<Option<RecordSet>> {
        while self.number < self.reader.times().len() {
            let number = self.number;
            self.number += 1;
            self.store.begin(number)?;
            let set = match self.reader.read(number, PixelMode::DecodedAndStored) {
                Ok(set) => set,
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => {
                    self.facts.lose(e.to_string());
                    continue;
                }
            };
            let mut refined = Vec::new();
            let mut missing = set.missing.clone();
            for at in 0..self.cameras.len() {
                match self.refined(number, &set, at)? {
                    Some(frame) => refined.push(frame),
                    None => missing.push(self.streams + at),
                }
            }
            let utc_ns = set.tick.ns().saturating_add(set.utc_offset_ns);
            let id = set.id;
            let tick = set.tick;
            let spread_ns = set.spread_ns;
            let mut frames: Vec<_> = set
                .frames
                .into_iter()
                .map(|f| {
                    let pixels = Box::new(ReadPixels { pixels: f.pixels, codec: f.codec, stored: f.stored });
                    RecordFrame { stream: f.stream, header: f.header, pixels }
                })
                .collect();
            frames.append(&mut refined);
            let utc = UtcPair { mono: tick, utc_ns, width_ns: 0 };
            let motion = set.motion;
            let signals = set.signals;
            return Ok(Some(RecordSet { id, tick, utc, frames, missing, motion, signals, spread_ns }));
        }
        Ok(None)
    }

    fn progress(&self) -> ImportProgress {
        ImportProgress { done: self.number as u64, total: self.reader.times().len() as u64 }
    }

    fn facts(&self) -> ImportFacts {
        let mut facts = self.facts.clone();
        let new = self.cameras.iter().zip(&self.numbers).map(|(camera, n)| StreamAccount {
            stream: camera.id.clone(),
            captured: *n,
            delivered: *n,
            dropped: DropCounts::default(),
        });
        facts.accounts.extend(new);
        facts
    }
}
