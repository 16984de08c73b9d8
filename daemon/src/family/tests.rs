//! A family is one type of settings and one line of the list: a toy family, which nothing else in the tree knows, is read,
//! planned, opened and supervised.

use super::{BackendConfig, CameraSettings, FAMILIES, Family, Offered, OpenContext, Reader, Source};
use crate::attached::tests::FakeAnswers;
use crate::config::{ConfigError, RigConfig};
use crate::doctor::{Severity, Surroundings, examine};
use crate::rig::{Rig, RigOptions};
use core::time::Duration;
use depthrig_bus::{HostTime, RuntimeDir};
use depthrig_driver::{Backend, MemorySink, Result, StreamRequest};
use depthrig_sim::synthetic::{StreamOverride, SyntheticBackend, SyntheticConfig, profiles};
use depthrig_usb::SysRoot;

/// A toy camera: colour at a rate.
#[derive(Debug, Clone, PartialEq)]
struct Toy {
    rate_hz: f64,
}

const TOY: Family = Family::new("toy", |r| Some(read(r)));

fn read(r: &Reader<'_>) -> BackendConfig {
    let table = r.section.table("spring", "[camera.spring]");
    let rate_hz =
        table.or("rate_hz", 30.0, |hz| if *hz > 0.0 { Ok(()) } else { Err("must be above 0".into()) });
    table.finish();
    BackendConfig::new(Toy { rate_hz })
}

impl Toy {
    /// The synthetic camera that is inside the toy.
    fn inside(&self) -> SyntheticConfig {
        let stream = depthrig_bus::Name::new("color").unwrap();
        let color = StreamOverride { stream, size: Some((64, 48)), rate_hz: Some(self.rate_hz) };
        SyntheticConfig {
            model: "generic".into(),
            cheap: true,
            streams: vec![color],
            ..SyntheticConfig::default()
        }
    }
}

impl CameraSettings for Toy {
    fn name(&self) -> &'static str {
        TOY.name
    }

    fn driver(&self, context: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(SyntheticBackend::with_drawing(vec![self.inside()], context.began, None)?))
    }

    fn source(&self) -> Source<'_> {
        let device = "a toy".to_owned();
        Source::Here(profiles(&self.inside()).map(|profiles| Offered { device, profiles }))
    }

    fn default_streams(&self) -> Vec<StreamRequest> {
        vec![StreamRequest::any(depthrig_bus::Name::new("color").unwrap())]
    }

    fn fastest_rate_hz(&self, _: &[StreamRequest]) -> Option<f64> {
        Some(self.rate_hz)
    }
}

/// The rig file `text` of toys, read with the toy as a last line of the list.
fn parse(keys: &str) -> core::result::Result<RigConfig, ConfigError> {
    let text = format!("rig = \"toys\"\n[[camera]]\nname = \"a\"\nbackend = \"toy\"\n{keys}");
    let families: Vec<_> = FAMILIES.iter().chain([&TOY]).copied().collect();
    RigConfig::parse_with(&text, None, &families)
}

fn problem(keys: &str) -> String {
    parse(keys).unwrap_err().to_string()
}

#[test]
fn a_new_family_is_read_from_its_own_keys() {
    let rig = parse("[camera.spring]\nrate_hz = 20.0").unwrap();
    assert_eq!(rig.cameras[0].backend, BackendConfig::new(Toy { rate_hz: 20.0 }));
    assert_ne!(rig.cameras[0].backend, BackendConfig::new(Toy { rate_hz: 30.0 }));
    assert_ne!(rig.cameras[0].backend, BackendConfig::new(SyntheticConfig::default()));
    assert_eq!(rig.cameras[0].streams[0].stream.as_str(), "color", "its default stream");

    let unknown = problem("[camera.spring]\nrate = 5.0");
    let expected = "unknown key \"rate\" in [camera.spring] of camera \"a\"; did you mean \"rate_hz\"?";
    assert!(unknown.ends_with(expected), "{unknown}");
    assert!(problem("[camera.spring]\nrate_hz = 0").ends_with("must be above 0"));
    let slow = problem("[camera.spring]\nrate_hz = 2.0");
    assert!(slow.contains("the fastest camera gives 2 frames a second"), "{slow}");
    assert!(problem("[camera.stereo]").contains("\"stereo\""), "a toy has no left and right images");
}

#[test]
fn messages_list_the_families_in_the_order_of_the_list() {
    let text = "rig = \"toys\"\n[[camera]]\nname = \"a\"\nbackend = \"toy\"\n";
    let without = RigConfig::parse(text, None).unwrap_err().to_string();
    let names = "synthetic, files, realsense, l515, v4l2, zed, external, kinect";
    assert!(without.ends_with(&format!("invalid value \"toy\"; it is one of: {names}")), "{without}");
    for family in FAMILIES {
        assert_eq!(super::find(family.name).map(|f| f.name), Some(family.name), "a name is there twice");
    }
}

#[test]
fn a_new_family_delivers_frames() {
    let home = tempfile::tempdir().unwrap();
    let rig = parse("").unwrap();
    let camera = &rig.cameras[0];
    let backend = camera.backend.driver(&OpenContext {
        runtime: &RuntimeDir::at(home.path()).unwrap(),
        rig: &rig.rig,
        camera: &camera.name,
        began: HostTime::now(),
        drawing: None,
    });
    let mut stream = backend.unwrap().open(None).unwrap().start(&camera.streams).unwrap();
    let mut sink = MemorySink::default();
    for _ in 0..100 {
        stream.poll(Duration::from_millis(100), &mut sink).unwrap();
        if !sink.frames.is_empty() {
            break;
        }
    }
    assert_eq!(sink.frames.first().map(|(_, _, pixels)| pixels.len()), Some(64 * 48 * 3));
}

#[test]
fn the_doctor_plans_a_new_family() {
    let home = tempfile::tempdir().unwrap();
    let mut config = parse("").unwrap();
    config.recording.directory = home.path().to_owned();
    let around = Surroundings { root: SysRoot::new(home.path()), runtime: None, measure_disk: false };
    let report = examine(&config, &around, &FakeAnswers::default()).unwrap();
    let camera = &report.cameras[0];
    assert_eq!((camera.backend, camera.device.as_deref()), ("toy", Some("a toy")));
    assert_eq!(camera.streams.len(), 1, "{:?}", camera.streams);
    assert_eq!(camera.worst.unwrap_or(Severity::Good), Severity::Good, "{:?}", report.findings);
}

#[test]
fn a_rig_runs_a_new_family_and_reports_it() {
    let home = tempfile::tempdir().unwrap();
    let runtime = RuntimeDir::at(&home.path().join("r")).unwrap();
    let mut config = parse("[supervisor]\nraise_priority = false\n").unwrap();
    config.recording.directory = home.path().to_owned();
    let rig = Rig::start(config, &RigOptions { serve_api: false, ..RigOptions::new(runtime) }).unwrap();
    let status = rig.control().status();
    assert_eq!(status.cameras[0].backend, "toy");
    let delivered = || rig.control().status().cameras[0].streams[0].delivered;
    let deadline = HostTime::now().plus(Duration::from_secs(20));
    while delivered() == 0 && HostTime::now() < deadline {
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(delivered() > 0, "{:?}", rig.control().status().cameras[0]);
}
