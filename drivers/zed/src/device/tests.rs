use super::*;

const SAMPLE: &str = include_str!("../conf/sample.conf");

#[test]
fn a_calibration_is_that_of_this_camera_or_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| {
        let path = dir.path().join(name);
        std::fs::write(&path, SAMPLE).unwrap();
        CalibrationFile::At(path)
    };
    let (loaded, source) = calibration(&at("SN31234.conf"), "31234").unwrap();
    assert!(
        loaded.is_some() && source.starts_with("factory ") && source.ends_with("SN31234.conf"),
        "{source}"
    );
    // A name that says nothing is believed.
    assert!(calibration(&at("left_bench.conf"), "31234").unwrap().0.is_some());
    let e = calibration(&at("SN4711.conf"), "31234").unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert!(e.to_string().contains("is the calibration of the camera 4711, and this one is 31234"), "{e}");
    let e = calibration(&CalibrationFile::At(dir.path().join("SN31234_.conf")), "31234").unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert!(e.to_string().contains("https://calib.stereolabs.com/?SN=31234"), "{e}");
    assert_eq!(calibration(&CalibrationFile::None, "31234").unwrap(), (None, "none".to_owned()));
}

#[test]
fn nothing_attached_is_said_and_bad_settings_are_refused_first() {
    let dir = tempfile::tempdir().unwrap();
    let root = SysRoot::new(dir.path());
    let backend = ZedBackend::new(ZedConfig::default()).with_root(root.clone());
    assert_eq!(backend.discover().unwrap(), []);
    let e = backend.open(None).err().unwrap();
    assert_eq!(e.kind(), ErrorKind::NotFound);
    let bad = ZedConfig { gain_percent: Some(101), ..ZedConfig::default() };
    assert_eq!(ZedBackend::new(bad).with_root(root).open(None).err().unwrap().kind(), ErrorKind::BadInput);
}
