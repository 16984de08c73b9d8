//! The rig of the paper matches the paper.

use super::super::{CameraConfig, RigConfig};
use super::{ExternalConfig, parse};

/// Depth modes: one of each camera, or those that its stereo gives.
fn depth_modes(rig: &RigConfig) -> Vec<String> {
    let of = |camera: &CameraConfig| match &camera.stereo {
        Some(stereo) => stereo.modes.iter().map(|m| format!("{} {m}", camera.name)).collect(),
        None => vec![camera.name.to_string()],
    };
    rig.cameras.iter().flat_map(of).collect()
}

#[test]
fn the_papers_rig_has_seven_cameras_and_ten_depth_modes() {
    let rig = parse(RigConfig::paper_text()).unwrap();
    let backends: Vec<_> = rig.cameras.iter().map(|c| c.backend.name()).collect();
    assert_eq!(backends, ["realsense", "realsense", "realsense", "realsense", "l515", "zed", "kinect"]);
    let stereo = ["performance", "quality", "ultra", "neural"].map(|m| format!("zed2i {m}"));
    let single = ["d405", "d415", "d435", "d455", "l515"].map(str::to_owned);
    let wanted: Vec<_> = single.into_iter().chain(stereo).chain(["kinect".to_owned()]).collect();
    assert_eq!(depth_modes(&rig), wanted);
    assert!((rig.sets.rate_hz - 5.0).abs() < f64::EPSILON);
    // They stand where the simulated ones do, so that the two can be compared.
    let simulated = parse(RigConfig::default_text()).unwrap();
    for camera in &rig.cameras {
        assert_eq!(
            Some(camera.pose),
            simulated.camera(camera.name.as_str()).map(|c| c.pose),
            "{}",
            camera.name
        );
    }
}

#[test]
fn an_oak_comes_in_by_taking_its_comment_away() {
    let with_oak = RigConfig::paper_text().replace("#e.g. ", "");
    let rig = parse(&with_oak).unwrap();
    assert_eq!(rig.cameras.len(), 8);
    let oak = rig.camera("oak").unwrap().backend.settings::<ExternalConfig>().unwrap();
    assert_eq!(oak.command[0], "depthrig-oak");
}

#[test]
fn a_misspelt_key_in_it_is_refused() {
    let text = RigConfig::paper_text();
    for (good, bad) in [
        ("\ndepth_mode =", "\ndept_mode ="),
        ("\nemitter =", "\nemiter ="),
        ("\nnetwork =", "\nnet ="),
        ("\ncalibration =", "\nconf ="),
    ] {
        assert!(text.contains(good));
        let error = parse(&text.replacen(good, bad, 1)).map(|_| ());
        assert!(error.is_err(), "{bad} was taken");
    }
}
