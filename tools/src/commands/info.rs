//! `depthrig info`: shows the contents of a dataset.

use crate::exit::Exit;
use crate::out;
use crate::printable::{self, path};
use anyhow::Result;
use depthrig_recorder::{Dataset, DatasetInfo, utc_text};
use serde::Serialize;
use std::path::PathBuf;

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct InfoArgs {
    /// Dataset folder
    dataset: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Contents of a dataset, and its recorded losses.
#[derive(Serialize)]
struct InfoReport<'a> {
    #[serde(flatten)]
    info: &'a DatasetInfo,
    lost: &'a [String],
}

/// Prints it. Exit code 3 if the dataset records a loss.
pub fn run(args: &InfoArgs) -> Result<Exit> {
    let dataset = Dataset::open(&args.dataset)?;
    let info = dataset.info()?;
    let lost = lost(&dataset, &info);
    if args.json {
        out::json(&InfoReport { info: &info, lost: &lost })?;
    } else {
        out::line(text(&info, &lost))?;
    }
    let good = lost.is_empty() && info.problems.is_empty() && info.unfinished.is_empty();
    Ok(if good { Exit::Good } else { Exit::Lost })
}

/// Losses that the dataset records: from its outcome, else from its last counters.
fn lost(dataset: &Dataset, info: &DatasetInfo) -> Vec<String> {
    let outcome = dataset.session().outcome.as_ref().filter(|o| !o.complete);
    let mut lost = outcome.map(|o| o.lost.clone()).unwrap_or_default();
    if lost.is_empty() {
        let counts = info.set_counts.unwrap_or_default();
        let counted = counts.dropped_by_reason();
        lost.extend(counted.map(|(reason, n)| format!("{n} sets were not recorded: {}", reason.name())));
    }
    if lost.is_empty() && outcome.is_some() {
        lost.push("the recording is not complete and does not say why".to_owned());
    }
    lost.extend(dataset.session().import_losses());
    lost
}

/// Tables of IMUs and signals.
fn beside_images(info: &DatasetInfo) -> Vec<String> {
    let mut lines = Vec::new();
    if !info.motion.is_empty() {
        lines.push(String::new());
        lines.push(out::table(
            &["IMU", "model", "samples", "Hz", "batches", "lost"],
            2,
            info.motion.iter().map(|m| {
                vec![
                    m.unit.clone(),
                    m.model.clone(),
                    m.samples.to_string(),
                    format!("{:.1}", m.rate_hz),
                    m.batches.to_string(),
                    m.lost_batches.to_string(),
                ]
            }),
        ));
    }
    if !info.signals.is_empty() {
        lines.push(String::new());
        lines.push(out::table(
            &["signal", "kind", "samples", "Hz", "lost", "restarts"],
            2,
            info.signals.iter().map(|s| {
                vec![
                    s.signal.clone(),
                    s.kind.to_owned(),
                    s.samples.to_string(),
                    format!("{:.1}", s.rate_hz),
                    s.lost.to_string(),
                    s.restarts.to_string(),
                ]
            }),
        ));
    }
    lines
}

/// Describes the dataset as text.
fn text(info: &DatasetInfo, lost: &[String]) -> String {
    let ms = |ns: i64| ns as f64 / 1e6;
    let or_none = |text: &str| if text.is_empty() { "-".to_owned() } else { printable::line(text) };
    let mut lines = vec![
        format!("dataset   {} ({})", printable::line(&info.name), path(&info.path)),
        format!(
            "rig       {}, scene {}, operator {}",
            printable::line(&info.rig),
            or_none(&info.scene),
            or_none(&info.operator)
        ),
        format!("started   {}", utc_text(info.started_utc_ns)),
        format!(
            "holds     {} ({} incomplete) over {}, {} in {}",
            out::count(info.sets, "set"),
            info.incomplete_sets,
            out::seconds(info.duration_ns as f64 / 1e9),
            out::bytes(info.bytes),
            out::count(info.segments, "segment")
        ),
        format!(
            "spread    p50 {:.1} ms, p95 {:.1} ms, max {:.1} ms",
            ms(info.spread.p50_ns),
            ms(info.spread.p95_ns),
            ms(info.spread.max_ns)
        ),
        String::new(),
        out::table(
            &[
                "stream",
                "model",
                "image",
                "format",
                "stored as",
                "frames",
                "missing",
                "Hz",
                "unit mm",
                "size",
                "of raw",
            ],
            5,
            info.streams.iter().map(|s| {
                let share = 100.0 * s.packed_bytes as f64 / (s.raw_bytes.max(1) as f64);
                let packed = if s.is_packed { " + zstd" } else { "" };
                vec![
                    s.stream.clone(),
                    s.model.clone(),
                    format!("{}x{}", s.width, s.height),
                    s.format.to_owned(),
                    format!("{}{packed}", s.codec),
                    s.frames.to_string(),
                    s.missing.to_string(),
                    format!("{:.2}", s.rate_hz),
                    if s.depth_unit_m > 0.0 { format!("{}", s.depth_unit_m * 1e3) } else { "-".to_owned() },
                    out::bytes(s.packed_bytes),
                    format!("{share:.0} %"),
                ]
            }),
        ),
    ];
    if !info.episodes.is_empty() {
        let used = info.episodes.iter().filter(|e| e.is_used()).count();
        lines.push(String::new());
        lines.push(format!("{}, {used} for exports", out::count(info.episodes.len(), "episode")));
        lines.extend(info.episodes.iter().map(|e| format!("  {}", printable::line(&e.text()))));
    }
    lines.extend(beside_images(info));
    let mut add = |what: &str, text: &str| lines.push(format!("{what}: {}", printable::line(text)));
    if let Some(c) = &info.calibration {
        let attached = c.attached_utc_ns.map_or_else(
            || "of the rig that recorded it".to_owned(),
            |t| format!("attached {}, before: {}", utc_text(t), c.before.as_deref().unwrap_or("none")),
        );
        add("calibration", &format!("made {}, {attached}", c.created));
    }
    info.history.iter().for_each(|e| add("edited", &format!("{} {}", utc_text(e.utc_ns), e.text())));
    info.computed.iter().for_each(|producer| add("computed", &producer.to_string()));
    for what in lost {
        add("lost", what);
    }
    info.unfinished.iter().for_each(|file| add("unfinished", file));
    info.problems.iter().for_each(|problem| add("problem", problem));
    lines.join("\n")
}
