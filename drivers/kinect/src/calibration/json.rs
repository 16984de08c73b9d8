//! The calibration's JSON text, read with every number checked, and written.

use super::{
    Calibration, CameraCalibration, DEFAULT_RADIUS, LensModel, MotionCalibration, RawIntrinsics, bad, pose,
};
use core::fmt::Display;
use core::ops::RangeInclusive;
use depthrig_bus::Pose;
use depthrig_driver::Result;
use glam::{DMat3, DQuat};
use serde_json::{Map, Value, json};

/// The most that is read: a real one has 4 to 8 kB.
const MAX_BYTES: usize = 1 << 20;
const DEPTH: &str = "CALIBRATION_CameraLocationD0";
const COLOR: &str = "CALIBRATION_CameraLocationPV0";
const GYROSCOPE: &str = "CALIBRATION_InertialSensorType_Gyro";
const ACCELEROMETER: &str = "CALIBRATION_InertialSensorType_Accelerometer";
const BROWN_CONRADY: &str = "CALIBRATION_LensDistortionModelBrownConrady";
const RATIONAL_6KT: &str = "CALIBRATION_LensDistortionModelRational6KT";

/// See [`Calibration::parse`].
pub(super) fn parse(text: &[u8]) -> Result<Calibration> {
    if text.len() > MAX_BYTES {
        return Err(bad(format_args!("{} bytes; it has a few thousand", text.len())));
    }
    let text = text.split(|b| *b == 0).next().unwrap_or_default();
    let root: Value =
        serde_json::from_slice(text).map_err(|e| bad(format_args!("no JSON: {e}")).with_source(e))?;
    let info =
        At { what: "CalibrationInformation".to_owned(), value: object(&root, "CalibrationInformation", "")? };
    let cameras = info.list("Cameras")?;
    let camera = |location: &str| -> Result<CameraCalibration> {
        let found = cameras.iter().find(|c| c.get("Location").and_then(Value::as_str) == Some(location));
        let Some(value) = found.and_then(Value::as_object) else {
            return Err(bad(format_args!("no camera with \"Location\": \"{location}\" in {}", info.what)));
        };
        read_camera(&At { what: location.to_owned(), value })
    };
    let depth = camera(DEPTH)?;
    let color = camera(COLOR)?;
    if depth.sensor != (1024, 1024) {
        return Err(bad(format_args!(
            "{DEPTH}: a sensor of {:?} pixels; a Kinect's has 1024x1024",
            depth.sensor
        )));
    }
    let width = u64::from(color.sensor.0);
    let height = u64::from(color.sensor.1);
    if width * 3 != height * 4 && width * 9 != height * 16 {
        return Err(bad(format_args!(
            "{COLOR}: a sensor of {width}x{height} pixels is neither 4:3 nor 16:9"
        )));
    }
    let sensors = info.value.get("InertialSensors").and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    let motion = |kind: &str| -> Result<Option<MotionCalibration>> {
        let found = sensors.iter().find(|s| s.get("SensorType").and_then(Value::as_str) == Some(kind));
        let Some(value) = found.and_then(Value::as_object) else { return Ok(None) };
        let sensor = At { what: kind.to_owned(), value };
        Ok(Some(MotionCalibration { sensor_from_device: sensor.rt()? }))
    };
    Ok(Calibration { depth, color, gyroscope: motion(GYROSCOPE)?, accelerometer: motion(ACCELEROMETER)? })
}

fn read_camera(camera: &At<'_>) -> Result<CameraCalibration> {
    let lens = camera.at("Intrinsics")?;
    let model = match lens.value.get("ModelType").and_then(Value::as_str) {
        Some(BROWN_CONRADY) => LensModel::BrownConrady,
        Some(RATIONAL_6KT) => LensModel::Rational6Kt,
        Some(other) => {
            return Err(lens.bad(format_args!("ModelType \"{other}\" is not one that Kinects have")));
        }
        None => return Err(lens.bad("no ModelType")),
    };
    let n = lens.number("ModelParameterCount", 14.0..=15.0)?;
    // The last of 15 is the metric radius, which has a key of its own.
    let [cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1] =
        lens.numbers("ModelParameters", n as usize)?;
    let within = |name: &str, value: f64, range: RangeInclusive<f64>| {
        if range.contains(&value) {
            return Ok(());
        }
        Err(lens.bad(format_args!("{name} = {value} is out of range {}..={}", range.start(), range.end())))
    };
    for (name, value) in [("cx", cx), ("cy", cy)] {
        within(name, value, 0.2..=0.8)?;
    }
    for (name, value) in [("fx", fx), ("fy", fy)] {
        within(name, value, 0.1..=5.0)?;
    }
    for (name, value) in [("k1", k1), ("k2", k2), ("k3", k3), ("k4", k4), ("k5", k5), ("k6", k6)] {
        within(name, value, -1000.0..=1000.0)?;
    }
    for (name, value) in [("codx", codx), ("cody", cody), ("p1", p1), ("p2", p2)] {
        within(name, value, -1.0..=1.0)?;
    }
    let radius = camera.number("MetricRadius", 0.0..=100.0)?;
    let side = |key| camera.number(key, 1.0..=16_384.0).map(|n| n as u32);
    Ok(CameraCalibration {
        intrinsics: RawIntrinsics {
            model,
            cx,
            cy,
            fx,
            fy,
            k: [k1, k2, k3, k4, k5, k6],
            p1,
            p2,
            center: [codx, cody],
        },
        // 0 means that the factory did not measure it.
        metric_radius: if radius <= 1e-4 { DEFAULT_RADIUS } else { radius },
        camera_from_device: camera.rt()?,
        sensor: (side("SensorWidth")?, side("SensorHeight")?),
    })
}

/// An object of the text and what messages call it.
struct At<'a> {
    what: String,
    value: &'a Map<String, Value>,
}

fn object<'a>(value: &'a Value, key: &str, what: &str) -> Result<&'a Map<String, Value>> {
    let found = value.get(key).and_then(Value::as_object);
    found.ok_or_else(|| bad(format_args!("{what}{}no object {key}", if what.is_empty() { "" } else { ": " })))
}

impl<'a> At<'a> {
    fn bad(&self, what: impl Display) -> depthrig_driver::Error {
        bad(format_args!("{}: {what}", self.what))
    }

    fn at(&self, key: &str) -> Result<At<'a>> {
        let value = self
            .value
            .get(key)
            .and_then(Value::as_object)
            .ok_or_else(|| self.bad(format_args!("no object {key}")))?;
        Ok(At { what: format!("{}.{key}", self.what), value })
    }

    fn list(&self, key: &str) -> Result<&'a [Value]> {
        let list = self.value.get(key).and_then(Value::as_array);
        list.map(Vec::as_slice).ok_or_else(|| self.bad(format_args!("no list {key}")))
    }

    fn number(&self, key: &str, range: RangeInclusive<f64>) -> Result<f64> {
        let n = self
            .value
            .get(key)
            .and_then(Value::as_f64)
            .ok_or_else(|| self.bad(format_args!("no number {key}")))?;
        if range.contains(&n) {
            return Ok(n);
        }
        Err(self.bad(format_args!("{key} = {n} is out of range {}..={}", range.start(), range.end())))
    }

    /// The first `N` of the `listed` numbers of `key`.
    fn numbers<const N: usize>(&self, key: &str, listed: usize) -> Result<[f64; N]> {
        let list = self.list(key)?;
        if list.len() < listed.max(N) {
            return Err(self.bad(format_args!("{key} has {} numbers, not {}", list.len(), listed.max(N))));
        }
        let mut out = [0.0; N];
        for (to, from) in out.iter_mut().zip(list) {
            *to = from.as_f64().ok_or_else(|| self.bad(format_args!("{from} in {key} is not a number")))?;
        }
        Ok(out)
    }

    fn rt(&self) -> Result<Pose> {
        let rt = self.at("Rt")?;
        pose(rt.numbers("Rotation", 9)?, rt.numbers("Translation", 3)?).map_err(|why| rt.bad(why))
    }
}

/// See [`Calibration::build`].
pub(super) fn build(c: &Calibration) -> String {
    let sensors = [(GYROSCOPE, &c.gyroscope), (ACCELEROMETER, &c.accelerometer)];
    let sensors = sensors.into_iter().filter_map(|(kind, sensor)| {
        let rt = build_rt(&sensor.as_ref()?.sensor_from_device);
        Some(json!({ "SensorType": kind, "Rt": rt }))
    });
    let cameras = [build_camera(&c.depth, DEPTH, "Depth"), build_camera(&c.color, COLOR, "PhotoVideo")];
    let sensors: Vec<_> = sensors.collect();
    json!({ "CalibrationInformation": { "Cameras": cameras, "InertialSensors": sensors } }).to_string()
}

fn build_camera(c: &CameraCalibration, location: &str, purpose: &str) -> Value {
    let RawIntrinsics { model, cx, cy, fx, fy, k: [k1, k2, k3, k4, k5, k6], p1, p2, center: [codx, cody] } =
        c.intrinsics;
    let model = if model == LensModel::BrownConrady { BROWN_CONRADY } else { RATIONAL_6KT };
    json!({
        "Intrinsics": {
            "ModelParameterCount": 14,
            "ModelParameters": [cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1],
            "ModelType": model,
        },
        "Location": location,
        "Purpose": format!("CALIBRATION_CameraPurpose{purpose}"),
        "MetricRadius": c.metric_radius,
        "Rt": build_rt(&c.camera_from_device),
        "SensorWidth": c.sensor.0,
        "SensorHeight": c.sensor.1,
        "Shutter": "CALIBRATION_ShutterTypeUndefined",
    })
}

fn build_rt(pose: &Pose) -> Value {
    let rows = DMat3::from_quat(DQuat::from_array(pose.rotation_xyzw)).transpose().to_cols_array();
    json!({ "Rotation": rows, "Translation": pose.translation_m })
}
