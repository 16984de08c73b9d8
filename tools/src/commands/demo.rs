//! `depthrig demo`: runs the full pipeline once, with synthetic cameras or those of a rig file.

use crate::commands::run::{self, Started};
use crate::context::{Context, private_folder};
use crate::demo::live::{Seen, Watcher};
use crate::demo::report::{self, DemoReport};
use crate::demo::{is_depth, mode_name, replayed, seeded, sheet};
use crate::exit::Exit;
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Context as _, Result, anyhow, bail};
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use depthrig_bus::{Bus, HostTime, Name, RuntimeDir, StreamId, UtcPair};
use depthrig_cdm::Precision;
use depthrig_cdm::stage::{EngineChoice, RefineConfig};
use depthrig_daemon::config::{CameraConfig, RigConfig};
use depthrig_daemon::control::{Control, EpisodeRequest, RecordRequest};
use depthrig_daemon::rig::{Rig, RigSummary};
use depthrig_daemon::status::{CameraStatus, RigStatus};
use depthrig_driver::StreamRequest;
use depthrig_recorder::report::REPORT_FILE;
use depthrig_recorder::{Dataset, EpisodeOutcome, VerifyOptions, verify};
use depthrig_sim::synthetic::SyntheticConfig;
use depthrig_sim::synthetic::arm::ArmSignals;
use depthrig_stereo::Mode;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The demo needs no camera and no daemon, and does not disturb a running one.

Examples:
  depthrig demo
  depthrig demo --seconds 60 --out /data/demo
  depthrig demo --json | jq .replay
  depthrig demo --config rig.toml      cameras of a rig file; `make demo` creates one with recordings";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct DemoArgs {
    /// Recording time, seconds
    #[arg(long, value_name = "N", default_value = "10", value_parser = crate::args::positive_seconds)]
    seconds: f64,
    /// New folder for dataset, images and report [default: demo-data/DATE_TIME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Rig configuration [default: seven synthetic cameras]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// The rig reads new signals after this at the latest, however busy the computer is.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Name of the dataset's folder in the demo's folder.
const DATASET: &str = "dataset";

/// Runs the demo.
pub fn run(args: &DemoArgs, context: &Context) -> Result<Exit> {
    let stop = Stop::on_signals()?;
    let folder = args.out.clone().unwrap_or_else(default_folder);
    if folder.join(DATASET).exists() {
        bail!("{}: a dataset exists already; name another folder with --out", folder.display());
    }
    let keep = Overwrite { overwrite: false };
    let contact_sheet = OutFile::new(&folder.join("contact-sheet.png"), keep, &[])?;
    let saved = OutFile::new(&folder.join("report.json"), keep, &[])?;
    depthrig_bus::umask::create_dir_all(&folder)
        .with_context(|| format!("{}: cannot be made", folder.display()))?;
    let Chosen { config, unavailable, untrained } = configuration(args.config.as_deref())?;
    let private = private_folder()?;
    let runtime = RuntimeDir::at(private.path())?;
    let name = config.rig.clone();
    let quiet = context.global.quiet > 0;

    let Started { rig, start_s } = run::start(config, runtime.clone(), false, None, quiet)?;
    let recorded = record(rig, &runtime, &folder, args, &stop, quiet)?;
    let mut progress = Progress::new(quiet);
    progress.set("verifying", 0, 1);
    let dataset = folder.join(DATASET);
    let verified = verify(&dataset, &VerifyOptions { decode: true, ..VerifyOptions::default() })?;
    progress.set("replaying", 0, 1);
    let replay = replayed::run(&dataset, &runtime, &name, &recorded.seen.checksums)?;
    progress.set("a depth model", 0, 1);
    let seeded = seeded::run()?;
    progress.clear();

    let info = Dataset::open(&dataset)?.info()?;
    let cameras: Vec<sheet::Camera<'_>> = recorded
        .live
        .cameras
        .iter()
        .filter_map(|c| Some(on_sheet(c, recorded.seen.shots.get(&c.name)?, &untrained)))
        .collect();
    contact_sheet.write(&crate::image_file::png(&sheet::contact_sheet(&cameras))?)?;
    let report = DemoReport {
        start_s,
        stop_s: recorded.stop_s,
        live: recorded.live,
        depth: recorded.seen.depth,
        refined: recorded.seen.refined,
        seeded,
        units_mm: recorded.seen.units_mm,
        recorded: report::modes(info.streams.iter().map(|s| (s.stream.as_str(), s.frames))),
        signals: info.signals,
        unavailable,
        untrained,
        sets_seen: recorded.seen.sets,
        frames_unread: recorded.seen.unread,
        summary: recorded.summary,
        verify: verified,
        replay,
        segments: Dataset::open(&dataset)?.segments().to_vec(),
        quality_report: dataset.join(REPORT_FILE),
        dataset,
        contact_sheet: contact_sheet.path().to_owned(),
    };
    saved.write(serde_json::to_string_pretty(&report)?.as_bytes())?;
    if args.json {
        out::json(&report)?;
    } else {
        out::line(report.text())?;
    }
    Ok(report.exit())
}

/// Refined images per camera and second: all seven share the remaining CPU time.
const REFINE_HZ: f64 = 2.0;

/// Rig of the demo.
struct Chosen {
    config: RigConfig,
    /// Depth modes that were removed from it, with the reason.
    unavailable: Vec<String>,
    /// Depth modes with an untrained network, by its file name.
    untrained: Vec<String>,
}

/// Loads the rig of `file`, else the default rig. Simulated cameras also publish true depth and, from the engine that
/// needs no model, refined depth as streams that are not recorded.
fn configuration(file: Option<&Path>) -> Result<Chosen> {
    let read = file.map_or_else(|| RigConfig::parse(RigConfig::default_text(), None), RigConfig::load);
    let mut config = read.map_err(depthrig_daemon::Error::from)?;
    for camera in &mut config.cameras {
        if let Some(settings) = camera.backend.settings_mut::<SyntheticConfig>() {
            settings.truth = true;
            settings.arm = true;
            // If the rig lists streams, add the ground truth of each in the same mode.
            for (of, truth) in [("depth", "depth_true"), ("color", "depth_true_color")] {
                if let Some(mode) = camera.streams.iter().find(|s| s.stream.as_str() == of).cloned() {
                    camera.streams.push(StreamRequest { stream: Name::new(truth)?, format: None, ..mode });
                }
            }
            camera.refine = Some(RefineConfig {
                engine: EngineChoice::Fill,
                rate_hz: REFINE_HZ,
                // The raw depth in the same view.
                align: true,
                ..RefineConfig::default()
            });
            camera.record = Some(vec![Name::new("color")?, Name::new("depth")?]);
        }
    }
    let unavailable = without_library(&mut config);
    let untrained = config.cameras.iter().filter(|c| has_untrained_network(c));
    let untrained = untrained.map(|c| mode_name(c.name.as_str(), "depth_neural")).collect();
    Ok(Chosen { config, unavailable, untrained })
}

/// Returns whether the camera's stereo network is untrained by its file name, as that of `make demo`.
fn has_untrained_network(camera: &CameraConfig) -> bool {
    let network = camera.stereo.as_ref().and_then(|s| s.network.as_ref());
    let stem = network.and_then(|file| file.file_stem()).and_then(|stem| stem.to_str());
    stem.is_some_and(|stem| stem.starts_with("untrained"))
}

/// A row of the contact sheet: colour, the depth modes (in the view of colour if available) and filled depth. The
/// output of an untrained network is left out: it would look like a defective camera.
fn on_sheet<'a>(
    camera: &CameraStatus,
    shots: &'a BTreeMap<String, sheet::Shot>,
    untrained: &[String],
) -> sheet::Camera<'a> {
    let how =
        if camera.backend == "synthetic" { "simulated".into() } else { format!("driver {}", camera.backend) };
    let mut tiles = Vec::new();
    let mut add = |stream: &str, label: &str| {
        if let Some(shot) = shots.get(stream) {
            tiles.push(sheet::Tile { label: label.to_owned(), shot });
        }
    };
    add("color", "colour");
    let shown = |s: &&String| is_depth(s) && !untrained.contains(&mode_name(&camera.name, s));
    let modes: Vec<&String> = shots.keys().filter(shown).collect();
    let has_modes = modes.len() > 1;
    if let [only] = modes[..]
        && shots.contains_key("depth_aligned")
        && only == "depth"
    {
        add("depth_aligned", "its depth, in the view of colour");
    } else {
        for mode in modes {
            add(mode, mode.strip_prefix("depth_").unwrap_or("its depth"));
        }
    }
    add("depth_refined", if has_modes { "one of them, holes filled" } else { "the same, holes filled" });
    let model = Some(&camera.model).filter(|model| !model.eq_ignore_ascii_case(&camera.name));
    let title =
        model.map_or_else(|| format!("{}: {how}", camera.name), |m| format!("{}: {m}, {how}", camera.name));
    sheet::Camera { title, tiles }
}

/// Removes stereo modes that need a network from a rig without a library to run it, and notes each.
fn without_library(config: &mut RigConfig) -> Vec<String> {
    let found = depthrig_cdm::find_library(config.cdm.library.as_deref(), "cpu", Precision::Fp32);
    let Err(why) = found else { return Vec::new() };
    let mut unavailable = Vec::new();
    for camera in &mut config.cameras {
        let Some(stereo) = camera.stereo.as_mut().filter(|s| s.modes.contains(&Mode::Neural)) else {
            continue;
        };
        stereo.modes.retain(|mode| *mode != Mode::Neural);
        stereo.network = None;
        unavailable.push(format!("{} {} is unavailable, because {why}", camera.name, Mode::Neural));
    }
    unavailable
}

struct Recorded {
    stop_s: f64,
    live: RigStatus,
    seen: Seen,
    summary: RigSummary,
}

/// Records for the requested time with a subscriber attached, then stops the rig.
fn record(
    rig: Rig,
    runtime: &RuntimeDir,
    folder: &Path,
    args: &DemoArgs,
    stop: &Stop,
    quiet: bool,
) -> Result<Recorded> {
    let control = rig.control();
    let status = control.status();
    let rig_name = Name::new(status.rig.as_str())?;
    let streams: Vec<StreamId> =
        status.cameras.iter().flat_map(|c| &c.streams).map(|s| s.id.parse()).collect::<Result<_, _>>()?;
    let bus = Bus::open(runtime, &rig_name)?;
    let ended = AtomicBool::new(false);
    let (live, seen) = std::thread::scope(|scope| -> Result<(RigStatus, Seen)> {
        let watcher = Watcher::new(&bus, &streams)?;
        let ended = &ended;
        let watching = scope.spawn(move || watcher.run(|| ended.load(Ordering::Relaxed)));
        let mut arm = ArmSignals::new(runtime)?;
        let moving = scope.spawn(move || arm.run(|| ended.load(Ordering::Relaxed)));
        let recording = || -> Result<RigStatus> {
            let request = RecordRequest {
                directory: Some(folder.to_owned()),
                name: Some(DATASET.into()),
                scene: "synthetic table".into(),
                force: true, // some seconds; it is the recording that says when the disk is full
                ..RecordRequest::default()
            };
            wait_for_signals(&*control)?;
            control.record_start(&request)?;
            control.episode(&EpisodeRequest::Start {
                task: "carry nothing from the ball to the plate".into(),
            })?;
            show_recording(args.seconds, stop, quiet);
            control.episode(&EpisodeRequest::Stop { outcome: Some(EpisodeOutcome::Success) })?;
            let live = control.status();
            control.record_stop()?;
            Ok(live)
        };
        let live = recording();
        ended.store(true, Ordering::Relaxed);
        let seen = watching.join().map_err(|_| anyhow!("the subscriber of the demo panicked"))?;
        moving.join().map_err(|_| anyhow!("the robot of the demo panicked"))??;
        Ok((live?, seen?))
    })?;
    if stop.is_asked() {
        rig.stop();
        bail!("interrupted; the recording up to then is in {}", folder.join(DATASET).display());
    }
    rig.finish_reports(); // so that the time to stop is that of the rig
    let began = HostTime::now();
    let summary = rig.stop();
    Ok(Recorded { stop_s: began.elapsed().as_secs_f64(), live, seen, summary })
}

/// Waits until the rig reads the arm's signals: then they are in the recording from its beginning.
fn wait_for_signals(control: &dyn Control) -> Result<()> {
    const LOOK: Duration = Duration::from_millis(20);
    let end = HostTime::now().plus(TIMEOUT);
    while control.status().signals.len() < ArmSignals::COUNT {
        if end.from_now().is_zero() {
            bail!("the rig does not read the signals of the simulated arm");
        }
        std::thread::sleep(LOOK);
    }
    Ok(())
}

fn show_recording(seconds: f64, stop: &Stop, quiet: bool) {
    let mut progress = Progress::new(quiet);
    let began = HostTime::now();
    let tenths = (seconds * 10.0).ceil() as u64;
    loop {
        let done = began.elapsed().as_secs_f64();
        progress.set("recording", ((done * 10.0) as u64).min(tenths), tenths);
        let left = seconds - done;
        if left <= 0.0 || stop.wait(Duration::from_secs_f64(left.min(0.1))) {
            return;
        }
    }
}

/// `demo-data/20261121_101500`, in UTC.
fn default_folder() -> PathBuf {
    let stamp = depthrig_recorder::utc_text(UtcPair::sample().utc_ns);
    let digits: String = stamp.chars().filter(char::is_ascii_digit).collect();
    let (date, time) = digits.split_at(8);
    Path::new("demo-data").join(format!("{date}_{time}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A computer without the library runs the other modes, and the report names the missing one with the reason.
    #[test]
    fn a_mode_without_its_library_is_taken_out_and_named() {
        let text = r#"
            rig = "r"
            [cdm]
            library = "/no/such/library"
            [[camera]]
            name = "zed2i"
            backend = "zed"
            input = "a.svo2"
            [camera.stereo]
            modes = ["performance", "neural"]
            network = "untrained.onnx"
        "#;
        let mut config = RigConfig::parse(text, None).unwrap();
        let unavailable = without_library(&mut config);
        let [why] = &unavailable[..] else { panic!("{unavailable:?}") };
        let named = "zed2i neural is unavailable, because ONNX Runtime was not found";
        assert!(why.starts_with(named) && why.contains("tools/onnxruntime.sh"), "{why}");
        let stereo = config.cameras[0].stereo.as_ref().unwrap();
        assert_eq!(stereo.modes, ["performance".parse().unwrap()]);
        assert_eq!(stereo.network, None);
        assert!(without_library(&mut config).is_empty(), "it is said once");
    }
}
