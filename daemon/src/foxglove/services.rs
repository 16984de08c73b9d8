//! The services that a viewer may call: a recording starts and stops.
//!
//! Both are `std_srvs/srv/Trigger`, which a viewer's panel fills in by itself, and whose response says whether it worked and why not. A protocol failure would leave
//! Lichtblick's panel waiting for ever: it has no handler for one.

use super::protocol::{Schema, Service, ServiceCall, ToClient};
use crate::control::{Control, RecordRequest};
use depthrig_bus::RigName;
use depthrig_recorder::trigger;
use serde::Serialize;

/// Encodings of requests and responses; viewers take the first that they know.
pub(crate) const SERVICE_ENCODINGS: [&str; 2] = ["cdr", "json"];

const START: u32 = 1;
const STOP: u32 = 2;

#[derive(Serialize)]
struct Response<'a> {
    success: bool,
    message: &'a str,
}

/// The message that announces the services.
pub(crate) fn advertise(rig: &RigName) -> String {
    let start = format!("/{rig}/record_start");
    let stop = format!("/{rig}/record_stop");
    let schema =
        |schema_name, schema| Schema { encoding: "cdr", schema_name, schema_encoding: "ros2msg", schema };
    let service = |id, name| Service {
        id,
        name,
        kind: trigger::TYPE,
        request: schema(trigger::REQUEST_TYPE, trigger::REQUEST),
        response: schema(trigger::RESPONSE_TYPE, trigger::RESPONSE),
    };
    let services = vec![service(START, start.as_str()), service(STOP, stop.as_str())];
    serde_json::to_string(&ToClient::AdvertiseServices { services }).unwrap_or_default()
}

/// Does what a client asks for and returns the response; the reason for none. It takes as long as the recording needs to begin or end.
pub(crate) fn call(control: &dyn Control, call: &ServiceCall) -> Result<Vec<u8>, String> {
    if !SERVICE_ENCODINGS.contains(&call.encoding.as_str()) {
        let known = SERVICE_ENCODINGS.join(", ");
        return Err(format!("encoding \"{}\" is unsupported; there are {known}", call.encoding));
    }
    let outcome = match call.service {
        START => control.record_start(&RecordRequest::default()).map(|status| status.path),
        STOP => control.record_stop().map(|status| {
            let lost = status.error.map_or_else(String::new, |lost| format!("; lost: {lost}"));
            format!("{}: {} sets{lost}", status.path, status.sets)
        }),
        unknown => return Err(format!("there is no service {unknown}")),
    };
    let success = outcome.is_ok();
    let message = outcome.unwrap_or_else(|e| e.to_string());
    let payload = if call.encoding == "json" {
        serde_json::to_vec(&Response { success, message: &message }).map_err(|e| e.to_string())?
    } else {
        trigger::response(success, &message)
    };
    Ok(call.response(&payload))
}
