//! The doctor's findings about cameras that other processes serve.

use super::*;
use crate::attached::{Ask, NodeFacts, Served};
use crate::family::Family;
use crate::status::RigStatus;
use core::cell::Cell;
use depthrig_bus::{Name, RuntimeDir};
use depthrig_driver::{DeviceInfo, Result, StreamProfile};
use depthrig_external::Place;
use std::path::Path;

const SERVED: &str = r#"
rig = "mount"
[recording]
directory = "/data"
[[camera]]
name = "front"
backend = "external"
"#;

/// Reports once that a process serves the camera, with its streams; or that none does.
struct Asked(Cell<Option<Result<PixelFormat>>>, RuntimeDir);

impl Ask for Asked {
    fn node(&self, _: &Path) -> Result<NodeFacts> {
        unreachable!("there is no node")
    }
    fn device(&self, _: &Family, _: &str) -> Option<Result<(DeviceInfo, Vec<StreamProfile>)>> {
        None
    }
    fn served(&self) -> Vec<Served> {
        let name = |n: &str| Name::new(n).unwrap();
        let place =
            Place { runtime: self.1.clone(), rig: Name::new("mount").unwrap(), camera: name("front") };
        let offer = |format| {
            let info = DeviceInfo { model: "OAK-D".into(), serial: "18".into(), ..DeviceInfo::default() };
            (info, vec![profile("color", format, 640, 480, 30.0)])
        };
        let offered = self.0.take();
        let holder = "process 4711 (oak)".to_owned();
        offered
            .into_iter()
            .map(|o| Served { place: place.clone(), holder: holder.clone(), offered: o.map(offer) })
            .collect()
    }
    fn may_open(&self, _: &Path) -> bool {
        true
    }
    fn rigs(&self) -> (Vec<RigStatus>, Vec<String>) {
        (Vec::new(), Vec::new())
    }
}

/// The report of a rig with a camera that a process serves, or not, as `offered` says.
fn served_report(text: &str, offered: Option<Result<PixelFormat>>) -> Report {
    let home = tempfile::Builder::new().prefix("dr").tempdir_in("/tmp").unwrap();
    let tree = FakeTree::new(home.path());
    let runtime = RuntimeDir::at(home.path()).unwrap();
    let attached = look(tree.root(), &Asked(Cell::new(offered), runtime)).unwrap();
    let config = config(text);
    judge(&config, &attached, cameras::plan(&config, &attached), &well(tree.root().clone()))
}

#[test]
fn cameras_of_other_processes_are_planned_by_what_those_offer() {
    let report = served_report(SERVED, Some(Ok(PixelFormat::Rgb8)));
    assert_eq!(ids(&report), []);
    let plan = &report.cameras[0];
    assert_eq!(plan.device.as_deref(), Some("OAK-D 18 at mount/front"));
    assert_eq!((plan.streams.len(), plan.port.as_deref()), (1, Some("mount/front")));
    assert!(report.disk.needed_bytes_per_s > 0.0, "it is planned with");

    let other_mode = format!("{SERVED}stream = [{{ name = \"color\", width = 1280, height = 720 }}]\n");
    let report = served_report(&other_mode, Some(Ok(PixelFormat::Rgb8)));
    assert_eq!(ids(&report), [("mode_missing", Severity::Error)]);

    let e = depthrig_driver::Error::new(ErrorKind::Disconnected, "has said nothing for 2.0 s");
    let report = served_report(SERVED, Some(Err(e)));
    assert_eq!(ids(&report), [("camera_failed", Severity::Error)]);
    assert!(
        all_text(&report.findings).contains("process 4711 (oak): has said nothing"),
        "{:?}",
        report.findings
    );
    let text = "process 4711 (oak) serves it and has said nothing for 2.0 s";
    let e = depthrig_driver::Error::new(ErrorKind::Disconnected, text);
    let report = served_report(SERVED, Some(Err(e)));
    assert_eq!(report.findings[0].what, text, "it is named once");
}

#[test]
fn a_camera_that_no_process_serves_is_missing_unless_the_daemon_can_start_one() {
    let report = served_report(SERVED, None);
    assert_eq!(ids(&report), [("camera_missing", Severity::Error)]);
    assert!(all_text(&report.findings).contains("`command`"));
    for (program, id, severity) in [
        ("sh", "external_not_running", Severity::Info),
        ("/bin/sh", "external_not_running", Severity::Info),
        ("/nowhere/cam", "command_missing", Severity::Error),
        ("no_such_program_anywhere", "command_missing", Severity::Error),
        ("/etc/passwd", "command_missing", Severity::Error),
    ] {
        let report = served_report(&format!("{SERVED}command = [\"{program}\"]\n"), None);
        assert_eq!(ids(&report), [(id, severity)], "{program}");
    }
}
