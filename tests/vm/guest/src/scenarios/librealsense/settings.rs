//! Options: their ranges against the emulated camera's own, and what the library writes as the driver reads it.

use super::Subject;
use anyhow::Context;
use depthrig_emulator::model::Control;
use serde_json::{Value, json};

/// An option of the library's, the sensor that has it, and the unit and selector that it stands for.
struct Option_ {
    sensor: &'static str,
    name: &'static str,
    unit: u8,
    selector: u8,
    /// The library's unit in those of the camera.
    scale: f64,
}

const fn option(sensor: &'static str, name: &'static str, unit: u8, selector: u8) -> Option_ {
    Option_ { sensor, name, unit, selector, scale: 1.0 }
}

/// Takes the least and the most exposure, the least and the most gain.
const SET_AE_LIMITS: u32 = 0x8A;
const STEREO: &str = "Stereo Module";
const RGB: &str = "RGB Camera";
const L515: &str = "L500 Depth Sensor";

/// Options that the models have in common: extension unit 3 and processing unit 2 (protocol facts of librealsense
/// `src/ds/ds-private.h`), and the colour module's units 6 and 7.
const STEREO_OPTIONS: [Option_; 2] = [option(STEREO, "exposure", 3, 0x03), option(STEREO, "gain", 2, 0x04)];
const PROJECTOR: [Option_; 1] = [option(STEREO, "laser_power", 3, 0x04)];
const COLOR: [(&str, u8); 9] = [
    ("backlight_compensation", 0x01),
    ("brightness", 0x02),
    ("contrast", 0x03),
    ("gain", 0x04),
    ("power_line_frequency", 0x05),
    ("hue", 0x06),
    ("saturation", 0x07),
    ("sharpness", 0x08),
    ("white_balance", 0x0A),
];

pub fn options(subject: &mut Subject<'_>) -> anyhow::Result<()> {
    let model = subject.model;
    let color_unit = if model == "d405" { 2 } else { 7 };
    let color_sensor = if model == "d405" { STEREO } else { RGB };
    let mut expected: Vec<Option_> = Vec::new();
    match model {
        "l515" => {}
        "d405" => expected.extend(STEREO_OPTIONS),
        _ => expected.extend(STEREO_OPTIONS.into_iter().chain(PROJECTOR)),
    }
    // Of a D405 the stereo module's own gain is that of its colour.
    expected.extend(
        COLOR
            .into_iter()
            .filter(|(name, _)| model != "d405" || *name != "gain")
            .map(|(name, selector)| option(color_sensor, name, color_unit, selector)),
    );
    if model == "l515" {
        expected.push(option(RGB, "auto_exposure_priority", 6, 0x03));
    }
    let mut found: Vec<(&str, Value)> = Vec::new();
    for sensor in [STEREO, RGB] {
        if expected.iter().any(|o| o.sensor == sensor) {
            found.push((sensor, subject.vendor.ask(&json!({ "do": "options", "sensor": sensor }))?));
        }
    }
    let mut wrong = Vec::new();
    let mut compared = 0;
    for o in &expected {
        let said = found.iter().find(|(s, _)| *s == o.sensor).map_or(&Value::Null, |(_, v)| &v[o.name]);
        let control =
            control(subject, o.unit, o.selector).with_context(|| format!("{} has no {}", model, o.name))?;
        let ours = [control.min, control.max, control.step, control.default].map(|v| v as f64 * o.scale);
        let theirs = ["min", "max", "step", "default"].map(|key| said[key].as_f64().unwrap_or(f64::NAN));
        compared += 1;
        if ours.iter().zip(theirs).any(|(a, b)| (a - b).abs() > 1e-6 || b.is_nan()) {
            wrong.push(format!("{}: {theirs:?} {said}, and not {ours:?}", o.name));
        }
    }
    subject.that(
        "the ranges of options are the camera's",
        wrong.is_empty() && compared > 7,
        format!("{compared} of them; {wrong:?}"),
    );
    let failing: Vec<String> = found
        .iter()
        .flat_map(|(_, v)| v.as_object().into_iter().flatten())
        // Temperatures are known only while it streams.
        .filter(|(name, v)| v.get("error").is_some() && !name.ends_with("temperature"))
        .map(|(name, v)| format!("{name}: {}", v["error"]))
        .collect();
    subject.that(
        "the library can read every option that it offers",
        failing.is_empty(),
        format!("{failing:?}"),
    );
    if model == "l515" {
        return Ok(());
    }
    let bounds = &found.first().context("no sensor")?.1["depth_units"];
    let range = ["min", "max"].map(|key| bounds[key].as_f64().unwrap_or(f64::NAN));
    let holds = (range[0] - 0.0001).abs() < 1e-8 && (range[1] - 0.01).abs() < 1e-8;
    subject.that("units of depth range from 0.1 to 10 mm", holds, format!("{range:?}"));
    limits(subject)
}

fn control(subject: &Subject<'_>, unit: u8, selector: u8) -> Option<Control> {
    let units = subject.camera.model().functions.iter().flat_map(|f| &f.units);
    units.filter(|u| u.id == unit).flat_map(|u| &u.controls).find(|c| c.selector == selector).cloned()
}

/// Requests whose order of numbers and whose errors the library alone decides.
fn limits(subject: &mut Subject<'_>) -> anyhow::Result<()> {
    for (option, value) in [("auto_exposure_limit", 50_000.0), ("auto_gain_limit", 120.0)] {
        let set = subject
            .vendor
            .ask(&json!({ "do": "set", "sensor": STEREO, "option": option, "value": value }))?;
        subject.that(&format!("{option} is kept"), set["value"].as_f64() == Some(value), &set);
    }
    // The other limit was kept when the second one was set.
    let again = subject.vendor.ask(&json!({ "do": "options", "sensor": STEREO }))?;
    let kept = again["auto_exposure_limit"]["value"].as_f64();
    subject.that("and does not disturb the other", kept == Some(50_000.0), format!("{kept:?}"));
    // The library writes back what it read: a reply in another order would be put right by the request.
    let asked = subject.camera.asked();
    let limits = asked.iter().rev().find(|a| a.opcode == SET_AE_LIMITS).map(|a| a.params);
    subject.that("the camera was given both", limits == Some([0, 50_000, 0, 120]), format!("{limits:?}"));
    if subject.model == "d405" {
        return Ok(());
    }
    for option in ["emitter_on_off", "hdr_enabled"] {
        for value in [1.0, 0.0] {
            let set = subject
                .vendor
                .ask(&json!({ "do": "set", "sensor": STEREO, "option": option, "value": value }))?;
            subject.that(&format!("{option} becomes {value}"), set["value"].as_f64() == Some(value), &set);
        }
    }
    Ok(())
}

/// The depth table that the library writes is what the driver opens the camera with.
pub fn advanced(subject: &mut Subject<'_>) -> anyhow::Result<()> {
    let before = subject.vendor.ask(&json!({ "do": "depth_table" }))?;
    let given = f64::from(subject.camera.model().depth_unit_um);
    let holds = before["enabled"] == true && before["depthUnits"].as_f64() == Some(given);
    subject.that("advanced mode is on, and its unit the model's", holds, &before);
    for units in [500.0, given] {
        let values = json!({ "depthUnits": units as u32, "disparityShift": 7 });
        let after = subject.vendor.ask(&json!({ "do": "set_depth_table", "values": values }))?;
        let opened = subject.backend().open(Some(subject.camera.serial()))?;
        let ours = opened.profiles().iter().find(|p| p.stream.as_str() == "depth").map(|p| p.depth_unit_m);
        let holds = after["depthUnits"].as_f64() == Some(units)
            && after["disparityShift"] == 7
            && ours.is_some_and(|unit| (unit - units * 1e-6).abs() < 1e-12);
        subject.that(
            &format!("a unit of {units} um is read back by the driver"),
            holds,
            format!("{ours:?}; {after}"),
        );
    }
    Ok(())
}

/// Requests that nothing but these make: the log of the firmware, which is empty, and two options of an L515.
pub fn rare(subject: &mut Subject<'_>) {
    let said = subject.vendor.ask(&json!({ "do": "firmware_log" })).err().map(|e| format!("{e:#}"));
    let said = said.unwrap_or_default();
    subject.that("the log of the firmware is empty", said.contains("No data to return"), &said);
    if !subject.is_l515() {
        return;
    }
    for (option, value) in [
        ("freefall_detection_enabled", 0.0),
        ("freefall_detection_enabled", 1.0),
        ("enable_max_usable_range", 1.0),
    ] {
        let request = json!({ "do": "set", "sensor": L515, "option": option, "value": value });
        let set = subject.vendor.ask(&request);
        let is_kept = set.as_ref().is_ok_and(|set| set["value"].as_f64() == Some(value));
        subject.that(&format!("{option} becomes {value}"), is_kept, format!("{set:?}"));
    }
}
