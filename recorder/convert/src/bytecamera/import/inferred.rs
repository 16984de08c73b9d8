//! Streams without a `calibration.json`: from the names of folders and files, and the first image of each.

use super::files::{FoundFiles, session_within};
use super::stream::Stream;
use super::{ByteCameraImport, FRAMES_FILE, UNITS_M, bad};
use crate::bytecamera::images::{Image, Want};
use crate::bytecamera::names;
use depthrig_bus::{Intrinsics, PixelFormat, Pose, StreamId};
use depthrig_recorder::{Result, StreamRecord};
use std::collections::BTreeMap;

/// Kind of image in the files of a name; `None` where a dataset has no such stream.
fn want_of(prefix: &str, ending: &str) -> Option<Want> {
    match (prefix, ending) {
        ("raw_depth", "npy") => Some(Want::Metres),
        (p, "png") if p == "depth" || p.starts_with("depth_") => Some(Want::Depth),
        (p, "png") if p.ends_with("color") => Some(Want::Color),
        (p, "png") if p.starts_with("ir") => Some(Want::Grey),
        _ => None,
    }
}

impl ByteCameraImport {
    /// Infers the streams from the names of folders and files and the first image of each.
    pub(super) fn inferred(&mut self, found: FoundFiles) -> Result<()> {
        let depth = found.keys().filter(|(_, prefix, ending)| want_of(prefix, ending) == Some(Want::Depth));
        let units = self.units_of_rows(depth.cloned().collect())?;
        let mut cameras: BTreeMap<String, String> = BTreeMap::new();
        for (key, files) in found {
            let listed = units.get(&key).copied().filter(|unit| UNITS_M.contains(unit));
            let (folder, prefix, ending) = key;
            let Some(want) = want_of(&prefix, &ending) else {
                self.state(format!(
                    "{folder}/{prefix}_N.{ending}: {} files are left out, a dataset has no such stream",
                    files.len()
                ));
                continue;
            };
            let part = folder.strip_prefix("camera_").unwrap_or(&folder);
            let (plain, model) = names::camera_of(part);
            let name = if let Some(known) = cameras.get(&folder) {
                names::name(known)
            } else {
                names::free(&plain, 2, |name| cameras.values().any(|taken| taken == name))
            };
            cameras.insert(folder.clone(), name.to_string());
            let stream = match prefix.as_str() {
                "R_color" => "color_right".to_owned(),
                other => names::name(other).to_string(),
            };
            let id = StreamId::new(name.as_str(), &stream).map_err(|e| bad(&self.dir.join(&folder), e))?;
            if self.streams.iter().any(|s| s.record.id == id) {
                return Err(bad(&self.dir.join(&folder), format_args!("stream {id} is there twice")));
            }
            let record = StreamRecord {
                id: id.clone(),
                model: model.clone(),
                serial: String::new(),
                format: PixelFormat::Z16,
                width: 0,
                height: 0,
                rate_hz: 0.0,
                depth_unit_m: 0.0,
                calibration: "none: the folders hold no calibration".to_owned(),
                intrinsics: Intrinsics::default(),
                pose: Pose::IDENTITY,
            };
            let mut stream = Stream::new(folder.clone(), prefix, ending, want, files, record);
            let Some(first) = self.first_image(&mut stream)? else { continue };
            let r = &mut stream.record;
            (r.format, r.width, r.height) = (first.format, first.width, first.height);
            if r.format == PixelFormat::Z16 {
                let given = self.given_unit(id.camera.as_str(), &folder);
                r.depth_unit_m = self.unit(&id, &model, &first.pixels, given, listed);
                stream.unit_given = given.is_some() || listed.is_none();
            } else if r.format == PixelFormat::DepthF32 {
                r.depth_unit_m = 1.0;
            }
            self.streams.push(stream);
        }
        if self.streams.is_empty() {
            if let Some(within) = session_within(&*self.fs, &self.dir) {
                let within = within.display();
                return Err(bad(&self.dir, format_args!("it holds sessions; import one, such as {within}")));
            }
            return Err(bad(
                &self.dir,
                "it holds no folder camera_<model> with depth_N.png, color_N.png, ir_N.png or raw_depth_N.npy",
            ));
        }
        "rig".clone_into(&mut self.session.rig);
        self.state("there is no calibration.json: no intrinsics, no poses".to_owned());
        Ok(())
    }

    /// The first image of a stream that can be read; it says format and size.
    fn first_image(&mut self, stream: &mut Stream) -> Result<Option<Image>> {
        let numbers: Vec<u32> = stream.files.keys().copied().collect();
        for n in numbers {
            if let Ok(image) = self.image(stream, n)? {
                return Ok(Some(image));
            }
        }
        for n in stream.files.keys() {
            let path = stream.path(*n);
            self.facts.lose(format!("{path}: no file of its kind can be read, the stream is left out"));
        }
        Ok(None)
    }

    /// The depth unit as `given`, else as `listed` in `frames.csv`, else as inferred; it is stated.
    fn unit(
        &mut self,
        id: &StreamId,
        model: &str,
        pixels: &[u8],
        given: Option<f64>,
        listed: Option<f64>,
    ) -> f64 {
        let mut values: Vec<u16> = pixels.as_chunks().0.iter().map(|v| u16::from_le_bytes(*v)).collect();
        values.retain(|v| *v != 0 && *v != u16::MAX);
        let middle = values.len() / 2;
        let median = if values.is_empty() { 0 } else { *values.select_nth_unstable(middle).1 };
        let (unit, why) = if let Some(unit) = given {
            let other = listed.filter(|listed| *listed != unit);
            (
                unit,
                other.map_or("as given".to_owned(), |other| format!("as given, {FRAMES_FILE} says {other}")),
            )
        } else if let Some(unit) = listed {
            (unit, format!("as {FRAMES_FILE} says"))
        } else if let Some(unit) = names::usual_depth_unit_m(model) {
            (unit, format!("inferred from the model {model}, which comes so"))
        } else {
            // Indoors the middle of an image is nearer than 8 m; in units of 0.1 mm it is then below 65535.
            let unit = if median > 8000 { 0.0001 } else { 0.001 };
            (unit, "inferred from the numbers of the first image".to_owned())
        };
        let metres = f64::from(median) * unit;
        self.state(format!(
            "{id}: depth unit {unit} m {why}; the first image's median is then {metres:.3} m"
        ));
        unit
    }
}
