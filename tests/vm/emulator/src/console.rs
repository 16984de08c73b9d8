//! The control socket of `emulate`: one line in, one line out. README.md lists the commands.

use crate::{Camera, Error, Fault, Hub, Options, Result, Speed};
use core::time::Duration;
use serde_json::{Value, json};

/// The cameras of a process, and what can be asked of them.
#[derive(Default)]
pub struct Console {
    cameras: Vec<Camera>,
}

fn seconds(word: &str) -> Result<Duration> {
    let value: f64 = word.parse().map_err(|_| Error::new(format!("'{word}' is not a number of seconds")))?;
    Duration::try_from_secs_f64(value).map_err(|e| Error::new(format!("{word} s: {e}")))
}

/// Reads `key=value` words into options.
///
/// # Errors
/// When a word is not an option or its value is invalid.
pub fn options<'a>(words: impl IntoIterator<Item = &'a str>) -> Result<Options> {
    let mut options = Options::default();
    for word in words {
        let (key, value) =
            word.split_once('=').ok_or_else(|| Error::new(format!("'{word}' is not key=value")))?;
        let wrong = || Error::new(format!("'{value}' is not a value of {key}"));
        match key {
            "serial" => options.serial = Some(value.to_owned()),
            "drift" => options.drift_ppm = value.parse().map_err(|_| wrong())?,
            "ticks" => options.start_ticks = value.parse().map_err(|_| wrong())?,
            "jitter" => options.jitter = seconds(value)?,
            "hub" => options.hub = value.parse().map_err(|_| wrong())?,
            "usb" => {
                options.speed = match value {
                    "3" => Speed::Super,
                    "2" => Speed::High,
                    _ => return Err(wrong()),
                }
            }
            _ => return Err(Error::new(format!("there is no option '{key}'"))),
        }
    }
    Ok(options)
}

impl Console {
    /// Executes a command line. The reply is a line that begins with `ok`, or the JSON of `status`; `None` is `quit`.
    ///
    /// # Errors
    /// When the command is unknown or failed.
    pub fn command(&mut self, line: &str) -> Result<Option<String>> {
        let words: Vec<&str> = line.split_whitespace().collect();
        let Some((name, rest)) = words.split_first() else { return Err(Error::new("an empty line")) };
        let word = |at: usize, what: &str| {
            rest.get(at).copied().ok_or_else(|| Error::new(format!("{name} lacks {what}")))
        };
        let reply = match *name {
            "plug" => {
                let camera = Camera::plug(word(0, "a model")?, options(rest[1..].iter().copied())?)?;
                let serial = camera.serial().to_owned();
                self.cameras.push(camera);
                format!("ok {serial}")
            }
            "unplug" => {
                let camera = self.camera(word(0, "a serial")?)?;
                match rest.get(1) {
                    Some(time) => camera.unplug_for(seconds(time)?)?,
                    None => camera.unplug()?,
                }
                "ok".into()
            }
            "replug" => {
                self.camera(word(0, "a serial")?)?.replug()?;
                "ok".into()
            }
            "remove" => {
                let serial = word(0, "a serial")?;
                self.camera(serial)?;
                self.cameras.retain(|c| c.serial() != serial);
                "ok".into()
            }
            "fault" => {
                let camera = self.camera(word(0, "a serial")?)?;
                camera.fault(rest[1..].join(" ").parse::<Fault>()?)?;
                "ok".into()
            }
            "hub-reset" => {
                let hub = word(0, "a hub")?;
                let hub =
                    hub.parse().map_err(|_| Error::new(format!("'{hub}' is not the number of a hub")))?;
                let count = Hub::reset(&self.cameras, hub, seconds(word(1, "a number of seconds")?)?)?;
                format!("ok {count}")
            }
            "status" => self.status().to_string(),
            "quit" => return Ok(None),
            other => return Err(Error::new(format!("there is no command '{other}'"))),
        };
        Ok(Some(reply))
    }

    fn camera(&self, serial: &str) -> Result<&Camera> {
        let found = self.cameras.iter().find(|c| c.serial() == serial);
        found.ok_or_else(|| Error::new(format!("there is no camera {serial}")))
    }

    /// Every camera, as JSON.
    pub fn status(&self) -> Value {
        let camera = |camera: &Camera| {
            let streams: serde_json::Map<String, Value> = camera
                .model()
                .streams()
                .filter_map(|s| Some((s.name.clone(), json!(camera.accounts(&s.name).ok()?))))
                .collect();
            json!({
                "serial": camera.serial(),
                "model": camera.model().name,
                "plugged": camera.is_plugged(),
                "port": camera.port_path(),
                "hub": camera.hub(),
                "streams": streams,
                "faults": camera.faults(),
            })
        };
        json!({ "cameras": self.cameras.iter().map(camera).collect::<Vec<_>>() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_line_says_what_is_wrong() {
        let mut console = Console::default();
        for (line, part) in [
            ("", "empty"),
            ("jump", "no command 'jump'"),
            ("plug", "lacks a model"),
            ("plug d435 usb=4", "'4' is not a value of usb"),
            ("plug d435 colour=red", "no option 'colour'"),
            ("unplug 1", "no camera 1"),
        ] {
            let text = console.command(line).unwrap_err().to_string();
            assert!(text.contains(part), "{line}: {text}");
        }
        assert_eq!(console.command("status").unwrap().unwrap(), r#"{"cameras":[]}"#);
        assert!(console.command("quit").unwrap().is_none());
    }
}
