//! Decisions before the first pair is matched: modes, streams, the session, and how many pairs at once.

use super::images::Maker;
use super::input::{Facts, Input};
use super::{CpuReport, Mode, ModeReport, ZedReplayOptions, ZedReplayReport, modes};
use depthrig_bus::{PixelFormat, StreamId};
use depthrig_calib::stereo::{Description, RowOffset};
use depthrig_calib::{PoseExt, Rectifier};
use depthrig_recorder::{ColorCodec, Computed, Error, ErrorKind, Result, StreamRecord};
use std::path::Path;
use std::sync::Arc;

/// Pairs in work beyond one for each thread.
pub(super) const AHEAD: usize = 2;
/// Sets that wait for the recorder's encoders.
pub(super) const QUEUE_SETS: usize = 2;

/// All that is known before the first pair is matched.
pub(super) struct Plan {
    pub(super) facts: Facts,
    pub(super) maker: Arc<Maker>,
    pub(super) modes: Vec<modes::ModeFacts>,
    pub(super) groups: Vec<modes::Group>,
    /// The first worker of each group.
    pub(super) first: Vec<modes::Worker>,
    unavailable: Vec<String>,
    notes: Vec<String>,
    /// The streams of the output: colour, then those of each mode.
    pub(super) streams: Vec<StreamRecord>,
    pub(super) session: depthrig_recorder::Session,
    pub(super) jobs: usize,
    memory_bytes: u64,
    pub(super) color: ColorCodec,
}

impl Plan {
    /// Creates every matcher once, so that unavailable ones are found before anything is written.
    pub(super) fn new(input: &mut Input, out: &Path, options: &ZedReplayOptions) -> Result<Self> {
        let facts = input.facts().clone();
        let c = &facts.calibration;
        let rectifier = Rectifier::new(&c.left, &c.right, &c.right_in_left, facts.size).map_err(|e| {
            Error::new(ErrorKind::BadInput, format!("the calibration ({}): {e}", facts.calibration_origin))
                .with_source(e)
        })?;
        let modes::Modes { facts: modes, groups, first, unavailable } =
            modes::Modes::open(&rectifier, options)?;
        let searched = modes::geometry(&rectifier).disparities(options.range_m.0);
        let nearest = rectifier.intrinsics().fx * rectifier.baseline_m() / searched as f64;
        let mut notes = Vec::new();
        if nearest > options.range_m.0 {
            let (w, h) = facts.size;
            notes.push(format!(
                "at {w}x{h} the presets see no nearer than {nearest:.2} m: they search {searched} disparities at most"
            ));
        }
        let maker = Maker {
            rectifier,
            colors: options.modes.contains(&Mode::Neural) && options.network.is_some(),
            depth_unit_m: options.depth_unit_m,
            range_m: options.range_m,
            disparity: options.disparity,
        };
        let mut plan = Self {
            facts,
            maker: Arc::new(maker),
            modes,
            groups,
            first,
            unavailable,
            notes,
            streams: Vec::new(),
            session: depthrig_recorder::Session::new("", ""),
            jobs: 1,
            memory_bytes: 0,
            color: options.color,
        };
        plan.jobs =
            (1..=options.jobs.max(1)).rev().find(|n| plan.memory(*n) <= options.memory_bytes).unwrap_or(1);
        plan.memory_bytes = plan.memory(plan.jobs);
        plan.describe(out)?;
        Ok(plan)
    }

    /// Bytes that `jobs` threads take: matchers, and pairs from reading to encoding.
    fn memory(&self, jobs: usize) -> u64 {
        let of = |g: &modes::Group| g.memory_bytes.saturating_mul(g.most.min(jobs) as u64);
        let matchers: u64 = self.groups.iter().map(of).sum();
        let pairs = (jobs + AHEAD + QUEUE_SETS + 1) as u64;
        matchers.saturating_add(self.maker.pair_bytes(self.modes.len()).saturating_mul(pairs))
    }

    /// The session and its streams.
    fn describe(&mut self, out: &Path) -> Result<()> {
        let facts = &self.facts;
        let rectifier = &self.maker.rectifier;
        let view = StreamRecord {
            id: stream_id(&facts.camera, "color")?,
            model: facts.model.clone(),
            serial: facts.serial.clone(),
            format: PixelFormat::Rgb8,
            width: facts.size.0,
            height: facts.size.1,
            rate_hz: facts.rate_hz,
            depth_unit_m: 0.0,
            calibration: format!("rectified with: {}", facts.calibration_origin),
            intrinsics: *rectifier.intrinsics(),
            pose: facts.pose.compose(&rectifier.left_view_in_left()),
        };
        let mut computed = vec![Computed {
            stream: view.id.clone(),
            name: "rectified".to_owned(),
            producer: format!("depthrig-rectify {}", env!("CARGO_PKG_VERSION")),
            parameters: format!(
                "focal_px={} baseline_m={}",
                rectifier.intrinsics().fx,
                rectifier.baseline_m()
            ),
            from: facts.from[..1].to_vec(),
        }];
        let mut streams = vec![view.clone()];
        let unit = self.maker.depth_unit_m;
        for mode in &self.modes {
            let mut add = |what: &str, format, depth_unit_m| {
                let id = stream_id(&facts.camera, &format!("{what}_{}", mode.name))?;
                let Description { producer, parameters, .. } = &mode.description;
                let (near, far) = self.maker.range_m;
                computed.push(Computed {
                    stream: id.clone(),
                    name: mode.recorded.clone(),
                    producer: producer.clone(),
                    parameters: format!("{parameters} min_depth_m={near} max_depth_m={far}"),
                    from: facts.from.clone(),
                });
                streams.push(StreamRecord { id, format, depth_unit_m, ..view.clone() });
                Ok::<_, Error>(())
            };
            add("depth", PixelFormat::Z16, unit)?;
            add("confidence", PixelFormat::Confidence8, 0.0)?;
            if self.maker.disparity {
                add("disparity", PixelFormat::DisparityF32, 0.0)?;
            }
        }
        let mut session = facts.session.clone();
        session.name = out.file_name().unwrap_or_default().to_string_lossy().into_owned();
        (session.streams, session.computed) = (streams.clone(), computed);
        if !self.unavailable.is_empty() {
            let all: Vec<_> = self.unavailable.iter().cloned().map(toml::Value::from).collect();
            let table = toml::Table::from_iter([("unavailable".to_owned(), all.into())]);
            session.extra.insert("zed_replay".to_owned(), table.into());
        }
        (self.session, self.streams) = (session, streams);
        Ok(())
    }

    /// Keeps the row offset of left and right in the session, corrects it where it is significant, and reports it
    /// where it is too large.
    pub(super) fn take_rows(&mut self, rows: Option<&RowOffset>) {
        let Some(rows) = rows else { return };
        // Before the work begins nobody else has the maker.
        let maker = Arc::get_mut(&mut self.maker).filter(|_| rows.is_significant());
        let is_corrected = maker.is_some();
        if let Some(maker) = maker {
            maker.rectifier.correct_rows(rows);
            for computed in self.session.computed.iter_mut().filter(|c| c.from.len() > 1) {
                computed.parameters = format!("{} {}", computed.parameters, rows.describe_correction());
            }
        }
        let warning = rows.warning(is_corrected);
        let table = self.session.extra.entry("zed_replay").or_insert_with(|| toml::Table::new().into());
        if let Some(table) = table.as_table_mut() {
            table.insert("rows".to_owned(), rows.to_string().into());
            table.insert("rows_corrected".to_owned(), is_corrected.into());
            table.extend(warning.clone().map(|w| ("warning".to_owned(), w.into())));
        }
        self.notes.extend(warning.map(|w| format!("{}: {w}", self.facts.camera)));
    }

    /// The settings that decide the pixels: a run goes on only with the same.
    pub(super) fn identity(&self, options: &ZedReplayOptions) -> serde_json::Value {
        let mode = |m: &modes::ModeFacts| {
            let d = &m.description;
            serde_json::json!({ "name": m.name, "producer": d.producer, "parameters": d.parameters })
        };
        let c = &self.facts.calibration;
        serde_json::json!({
            "depthrig_version": env!("CARGO_PKG_VERSION"),
            "input": self.facts.identity,
            "modes": self.modes.iter().map(mode).collect::<Vec<_>>(),
            "calibration": format!("{:?} {:?} {:?}", c.left, c.right, c.right_in_left),
            "disparity": options.disparity,
            "range_m": options.range_m,
            "depth_unit_m": options.depth_unit_m,
            "color": options.color,
        })
    }

    pub(super) fn report(&self, out: &Path) -> ZedReplayReport {
        let mode = |m: &modes::ModeFacts| ModeReport {
            mode: m.name.to_owned(),
            recorded_as: m.recorded.clone(),
            producer: m.description.producer.clone(),
            parameters: m.description.parameters.clone(),
            frames: 0,
            shared_with: Vec::new(),
            stereo_s: 0.0,
        };
        ZedReplayReport {
            path: out.to_owned(),
            sets: 0,
            bytes: 0,
            modes: self.modes.iter().map(mode).collect(),
            unavailable: self.unavailable.clone(),
            lost: 0,
            problems: Vec::new(),
            notes: self.notes.clone(),
            resumed: 0,
            jobs: self.jobs,
            memory_bytes: self.memory_bytes,
            cpu: CpuReport::default(),
            ended: false,
            verified: None,
        }
    }
}

fn stream_id(camera: &str, stream: &str) -> Result<StreamId> {
    StreamId::new(camera, stream).map_err(|e| Error::new(ErrorKind::BadInput, e.to_string()))
}
