//! The keys of an `l515` camera. The range of a control is checked by the camera when it is started.

use super::L515Settings;
use super::controls;
use super::read::Section;
use super::wanted::WantedStream;
use depthrig_drivers::StreamRequest;
use depthrig_drivers::motion::IMU;
use depthrig_drivers::realsense::protocol::l515::Control;

const STREAMS: [&str; 5] = ["depth", "color", "ir", "confidence", IMU];

/// Reads the settings of a camera that is asked for `streams`.
pub(super) fn read(s: &Section<'_, '_>, streams: &[WantedStream]) -> L515Settings {
    let text = |key| s.or(key, None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let mut settings = L515Settings {
        serial: text("serial"),
        port: text("port"),
        color_controls: controls::read(s, "color_controls", "color_controls = { }"),
        ..L515Settings::default()
    };
    for (name, found) in s.entries::<i32>("controls", "controls = { }") {
        if Control::from_name(&name).is_none() {
            let known = Control::ALL.map(Control::name).join(", ");
            let why = format!("has \"{name}\", which an L515 has not; it has: {known}");
            s.problem(found.at, format!("{} {why}", s.key_of("controls")));
        }
        settings.controls.insert(name, found.value);
    }
    for wanted in streams {
        let name = wanted.request.stream.as_str();
        if !STREAMS.contains(&name) {
            let why = format!("an L515 has no stream \"{name}\"; it has: {}", STREAMS.join(", "));
            s.problem(wanted.at, why);
        }
    }
    let asks_color = streams.is_empty() || streams.iter().any(|w| w.request.stream.as_str() == "color");
    if !settings.color_controls.is_empty() && !asks_color {
        let why = "is set, but color is not among the streams of its [[camera.stream]] tables";
        s.problem(s.at_key("color_controls"), format!("{} {why}", s.key_of("color_controls")));
    }
    settings
}

/// The streams that are started when the file names none.
pub(super) fn default_streams() -> Vec<StreamRequest> {
    super::realsense::default_streams()
}
