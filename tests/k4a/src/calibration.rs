//! The calibration that a camera reports: JSON text with the keys of real ones and invented numbers.

/// Parameters in the order cx, cy, fx, fy, k1 to k6, codx, cody, p2, p1.
pub const DEPTH: [f64; 14] =
    [0.5125, 0.516, 0.4925, 0.493, 0.9, 0.25, 0.012, 1.22, 0.4, 0.06, 0.0, 0.0, -0.000_03, 0.000_09];
/// The same of colour.
pub const COLOR: [f64; 14] =
    [0.4985, 0.504, 0.476, 0.635, 0.55, -2.8, 1.55, 0.43, -2.6, 1.47, 0.0, 0.0, -0.000_15, 0.000_4];
/// Depth as colour sees it, metres.
pub const TRANSLATION: [f64; 3] = [-0.032, -0.002, 0.004];

/// The text, with the zero byte at its end that the device sends.
pub fn text(serial: &str) -> Vec<u8> {
    let camera = |location: &str, parameters: &[f64], t: [f64; 3], size: (u32, u32)| {
        format!(
            r#"{{"Intrinsics":{{"ModelParameterCount":14,"ModelParameters":{parameters:?},"ModelType":"CALIBRATION_LensDistortionModelBrownConrady"}},"Location":"CALIBRATION_CameraLocation{location}","Purpose":"CALIBRATION_CameraPurposeDepth","MetricRadius":1.74,"Rt":{{"Rotation":[1,0,0,0,1,0,0,0,1],"Translation":{t:?}}},"SensorHeight":{},"SensorWidth":{}}}"#,
            size.1, size.0
        )
    };
    let cameras =
        [camera("D0", &DEPTH, [0.0; 3], (1024, 1024)), camera("PV0", &COLOR, TRANSLATION, (4096, 3072))]
            .join(",");
    let mut text = format!(
        r#"{{"CalibrationInformation":{{"Cameras":[{cameras}],"InertialSensors":[],"Metadata":{{"SerialId":"{serial}"}}}}}}"#
    )
    .into_bytes();
    text.push(0);
    text
}
