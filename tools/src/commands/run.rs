//! `depthrig run`: the daemon in the foreground.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, RuntimeDir};
use depthrig_daemon::Showing;
use depthrig_daemon::config::{CameraConfig, Port, RigConfig};
use depthrig_daemon::control::{Control, RecordRequest, Shows};
use depthrig_daemon::rig::{Rig, RigOptions, RigSummary};
use depthrig_daemon::status::{CameraStatus, RefineState, SignalState};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The first Ctrl-C or SIGTERM closes a recording and exits cleanly; a second one exits at once.

Examples:
  depthrig run rig.toml
  depthrig run rig.toml --record data --seconds 60 --scene kitchen
  depthrig run rig.toml --foxglove        then `depthrig open --foxglove` prints the address for the viewer
  depthrig run rig.toml --log-format json 2>> depthrig.log";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct RunArgs {
    /// Rig configuration (`depthrig config show` prints one to start from)
    config: PathBuf,
    /// Record from the start, into a new folder in DIR
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Scene label of the recording
    #[arg(long, value_name = "LABEL", requires = "record", default_value = "")]
    scene: String,
    /// Operator of the recording
    #[arg(long, value_name = "NAME", requires = "record", default_value = "")]
    operator: String,
    /// Record even if the disk is expected to fill up too soon
    #[arg(long, requires = "record")]
    force: bool,
    /// Stop after N seconds
    #[arg(long, value_name = "N", value_parser = crate::args::positive_seconds)]
    seconds: Option<f64>,
    /// Serve Foxglove and Lichtblick on this loopback port [default without PORT: 8765]
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "8765", require_equals = true)]
    foxglove: Option<u16>,
    /// Publish the rig to ROS 2: run depthrig-ros2 as long as the rig (docs/ros2.md)
    #[arg(long)]
    ros2: bool,
    /// Print the summary as JSON at the end
    #[arg(long)]
    json: bool,
}

/// Runs the rig until a signal, the time limit or an API request stops it.
pub fn run(args: &RunArgs, context: &Context) -> Result<Exit> {
    let mut config = RigConfig::load(&args.config).map_err(depthrig_daemon::Error::from)?;
    if let Some(rig) = &context.global.rig {
        config.rig = rig.clone();
    }
    if let Some(port) = args.foxglove {
        config.control.foxglove = Port::loopback(port);
    }
    if args.ros2 {
        config.ros2.get_or_insert_default();
    }
    let is_recorded = |camera: &&CameraConfig| camera.refine.as_ref().is_some_and(|r| r.record);
    let refined: Vec<_> = config.cameras.iter().filter(is_recorded).map(|c| c.name.to_string()).collect();
    let stop = Stop::on_signals()?;
    let Started { rig, .. } = start(config, context.runtime()?, true, None, context.global.quiet > 0)?;
    if let Some(port) = rig.port().filter(|_| context.global.quiet == 0) {
        out::note(format_args!("live page: http://{port}/, open it with: depthrig open"));
    }
    let control = rig.control();
    if let Some(directory) = &args.record
        && wait_until_drawn(&rig, &stop, context.global.quiet > 0)
        && wait_for_inputs(&rig, &refined, &stop, context.global.quiet > 0)
    {
        let request = RecordRequest {
            directory: Some(directory.clone()),
            scene: args.scene.clone(),
            operator: args.operator.clone(),
            force: args.force,
            ..RecordRequest::default()
        };
        if let Err(e) = control.record_start(&request) {
            rig.stop();
            return Err(e.into());
        }
    }
    wait(&rig, &stop, args.seconds);
    let summary = rig.stop();
    if args.json {
        out::json(&summary)?;
    } else {
        print_summary(&summary)?;
    }
    Ok(if summary.lost.is_empty() { Exit::Good } else { Exit::Lost })
}

/// Waits until the simulated cameras' scenes are fully rendered; coarse images are not recorded. Returns false when the
/// rig was asked to stop meanwhile.
fn wait_until_drawn(rig: &Rig, stop: &Stop, quiet: bool) -> bool {
    const LOOK: Duration = Duration::from_millis(100);
    let mut shown = Progress::new(quiet);
    let mut announced = false;
    // After a rendering error there is no progress; starting the recording then reports that error.
    while let Some(p) = rig.drawing().filter(|p| p.error.is_none()) {
        if quiet && !announced {
            announce_rendering();
        }
        announced = true;
        shown.set("rendering, then recording", p.done as u64, p.total as u64);
        if rig.is_stop_asked() || stop.wait(LOOK) {
            return false;
        }
    }
    true
}

/// Waits until the refiners of these cameras run or have failed, and required signals come: the first sets of a recording would
/// lack refined depth, or the recording be refused. Returns false when the rig was asked to stop meanwhile.
fn wait_for_inputs(rig: &Rig, cameras: &[String], stop: &Stop, quiet: bool) -> bool {
    const LOOK: Duration = Duration::from_millis(100);
    let control = rig.control();
    let mut shown = Progress::new(quiet);
    let is_starting = |c: &CameraStatus| {
        cameras.contains(&c.name) && c.refine.as_ref().is_some_and(|r| r.state == RefineState::Starting)
    };
    loop {
        let status = control.status();
        let required = status.signals.iter().filter(|s| s.required);
        let silent: Vec<_> = required.clone().filter(|s| s.state != SignalState::Live).collect();
        let starting = status.cameras.iter().filter(|&c| is_starting(c)).count();
        let all = cameras.len() + required.count();
        let label = match silent.first() {
            Some(signal) => format!("waiting for signal {}, then recording", signal.signal),
            None if starting > 0 => "starting refiners, then recording".to_owned(),
            None => return true,
        };
        shown.set(&label, (all - starting - silent.len()) as u64, all as u64);
        if rig.is_stop_asked() || stop.wait(LOOK) {
            return false;
        }
    }
}

/// Prints one line even with `--quiet`, because rendering can take minutes.
fn announce_rendering() {
    eprintln!(
        "rendering the simulated cameras' images, once; minutes on a busy computer, then kept for next time"
    );
}

/// A rig whose cameras stream.
pub struct Started {
    /// The rig.
    pub rig: Rig,
    /// Duration of the start without rendering, seconds.
    pub start_s: f64,
}

/// Starts a rig and shows the progress of rendering its images.
pub fn start(
    config: RigConfig,
    runtime: RuntimeDir,
    serve_api: bool,
    cache_dir: Option<PathBuf>,
    quiet: bool,
) -> Result<Started> {
    let shared = Arc::new(Mutex::new((Progress::new(quiet), HostTime::now())));
    let shown = shared.clone();
    let announced = AtomicBool::new(!quiet);
    let progress = move |camera: &str, done: usize, total: usize| {
        if done < total && !announced.swap(true, Ordering::Relaxed) {
            announce_rendering();
        }
        let what = format!("rendering {camera} (kept for next time)");
        let mut shown = lock(&shown);
        shown.0.set(&what, done as u64, total as u64);
        shown.1 = HostTime::now();
    };
    let shows = serve_api.then(|| Showing::new(&runtime, &config.rig)).transpose()?;
    let options = RigOptions {
        serve_api,
        shows: shows.map(|shows| Arc::new(shows) as Arc<dyn Shows>),
        join: Some(depthrig_daemon::joining::join),
        cache_dir,
        progress: Some(Box::new(progress)),
        // With an API, subscribers can query the rendering progress, so streaming starts at once.
        draw_while_running: serve_api,
        ..RigOptions::new(runtime)
    };
    let rig = Rig::start(config, &options);
    let mut shared = lock(&shared);
    shared.0.clear();
    Ok(Started { rig: rig?, start_s: shared.1.elapsed().as_secs_f64() })
}

/// Waits for a signal, the time limit, or the rig's own end (an API request, or every camera is done).
pub fn wait(rig: &Rig, stop: &Stop, seconds: Option<f64>) {
    let deadline = seconds.map(|s| HostTime::now().plus(Duration::from_secs_f64(s)));
    let control: Arc<dyn Control> = rig.control();
    let ended = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let ended = &ended;
        scope.spawn(move || {
            while !ended.load(Ordering::Relaxed) {
                if stop.wait(Duration::from_millis(50)) {
                    control.request_stop();
                    return;
                }
            }
        });
        rig.wait(deadline);
        ended.store(true, Ordering::Relaxed);
    });
}

fn print_summary(summary: &RigSummary) -> Result<()> {
    let status = &summary.status;
    let delivered: u64 = status.cameras.iter().flat_map(|c| &c.streams).map(|s| s.delivered).sum();
    out::line(format_args!(
        "rig {} ran {}: {} of {}, {}",
        status.rig,
        out::seconds(status.uptime_s),
        out::count(delivered, "frame"),
        out::count(status.cameras.len(), "camera"),
        out::count(status.sets.sent, "set")
    ))?;
    if let Some(recording) = &summary.recording {
        out::line(format_args!(
            "recorded {}: {}, {}, {} over {}",
            recording.path.display(),
            out::count(recording.sets.recorded, "set"),
            out::count(recording.frames, "frame"),
            out::bytes(recording.bytes),
            out::seconds(recording.duration_ns as f64 / 1e9)
        ))?;
    }
    for lost in &summary.lost {
        out::line(format_args!("lost: {lost}"))?;
    }
    Ok(())
}
