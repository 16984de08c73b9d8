//! Refiners that `depthrig eval` runs: engines, models, and raw depth with its holes filled.

use super::filled::nearest;
use super::read::Metres;
use super::{Loaded, Source};
use crate::commands::cdm::store::usage;
use crate::exit::UsageError;
use anyhow::{Context, Result, bail};
use depthrig_cdm::tiny::{TinyFile, is_tiny_file};
use depthrig_cdm::{
    Color, ColorFormat, EngineKind, ErrorKind, Job, ModelStore, Output, Precision, RawDepth, Refiner,
    RefinerOptions, StepTimes,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Raw depth with each hole filled by the nearest measured depth, as a row of its own.
pub const FILLED: &str = "filled";
/// The other input of a model in the paper's table.
const HOLED: &str = "holed";

/// Description of a row of the table.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RowInfo {
    /// Prediction.
    pub name: String,
    /// Input of the refiner: `holed` (raw depth as it is) or `filled`; empty for what was read.
    pub input: String,
    /// Engine, version and device; empty for what was read.
    pub engine: String,
    /// Model with the beginning of its hash; empty without one.
    pub model: String,
}

/// A refiner of the command line: `[NAME=]ENGINE|MODEL[:filled]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Choice {
    name: String,
    what: String,
    filled: bool,
}

/// How refiners are run.
#[derive(Debug, Clone)]
pub struct RunOptions {
    /// Folder of models.
    pub models: Option<PathBuf>,
    /// Where networks run.
    pub device: String,
    /// The numbers that they compute with.
    pub precision: Precision,
    /// Shorter side of their input; `None` is the model's.
    pub input_size: Option<u32>,
    /// ONNX Runtime.
    pub library: Option<PathBuf>,
    /// Threads.
    pub threads: usize,
}

struct Row {
    info: RowInfo,
    filled: bool,
    /// None for [`FILLED`].
    refiner: Option<Box<dyn Refiner>>,
}

/// The refiners, ready to run.
#[derive(Default)]
pub struct Refiners(Vec<Row>);

impl Choice {
    /// Parses a refiner.
    ///
    /// # Errors
    /// When a part is empty.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (name, rest) = text.split_once('=').map_or((None, text), |(n, r)| (Some(n), r));
        let (what, input) =
            rest.rsplit_once(':').filter(|(_, i)| [FILLED, HOLED].contains(i)).unwrap_or((rest, HOLED));
        if what.is_empty() || name == Some("") {
            return Err(format!(
                "write an engine or a model, such as fill or cdm-d435:{FILLED}, not \"{text}\""
            ));
        }
        let filled = input == FILLED;
        let own = if filled { format!("{what} ({FILLED})") } else { what.to_owned() };
        Ok(Self { name: name.map_or(own, str::to_owned), what: what.to_owned(), filled })
    }
}

impl Refiners {
    /// Opens all of `choices`.
    ///
    /// # Errors
    /// A usage error for what is neither an engine nor a model, and two rows of one name; when a model or ONNX Runtime is
    /// missing.
    pub fn open(choices: &[Choice], options: &RunOptions) -> Result<Self> {
        let open =
            |c: &Choice| Row::open(c, options).with_context(|| format!("--refine {}: unusable", c.name));
        Ok(Self(choices.iter().map(open).collect::<Result<_>>()?))
    }

    /// The rows of a source and of these refiners.
    ///
    /// # Errors
    /// When two have one name.
    pub fn rows(&self, source: &dyn Source) -> Result<Vec<RowInfo>> {
        let read = source.names().iter().map(|n| RowInfo { name: n.clone(), ..RowInfo::default() });
        let rows: Vec<RowInfo> = read.chain(self.0.iter().map(|r| r.info.clone())).collect();
        for (i, row) in rows.iter().enumerate() {
            if rows[..i].iter().any(|r| r.name == row.name) {
                let text = format!("two rows are called {}; name one with NAME=", row.name);
                return Err(UsageError(text).into());
            }
        }
        Ok(rows)
    }

    /// Adds the predictions of every refiner to images with raw depth; their rows begin at `first`. An image that it refuses
    /// is an error of its own.
    ///
    /// # Errors
    /// When an engine fails.
    pub fn refine(&mut self, first: usize, images: Vec<Loaded>) -> Result<Vec<Result<Loaded>>> {
        images.into_iter().map(|image| self.one(first, image)).collect()
    }

    fn one(&mut self, first: usize, mut image: Loaded) -> Result<Result<Loaded>> {
        let Some((_, raw)) = &image.raw else { return Ok(Ok(image)) };
        if self.0.is_empty() {
            return Ok(Ok(image));
        }
        let name = image.place.name.clone();
        let size = (raw.width, raw.height);
        let any_filled = self.0.iter().any(|r| r.filled);
        let filled = if any_filled { nearest(&raw.pixels, raw.width) } else { Vec::new() };
        for (k, row) in self.0.iter_mut().enumerate() {
            let depth =
                RawDepth { pixels: if row.filled { &filled } else { &raw.pixels }, unit_m: raw.unit_m };
            let Some(refiner) = &mut row.refiner else {
                let filled = super::read::Raw { pixels: filled.clone(), ..raw.clone() };
                image.predictions.push((first + k, filled.metres()));
                continue;
            };
            let Some(color) = &image.color else {
                return Ok(Err(anyhow::anyhow!(
                    "{name}: no colour image, which refiners need; name their folder with --rgb"
                )));
            };
            let color_size = (color.width() as usize, color.height() as usize);
            if color_size != size {
                return Ok(Err(anyhow::anyhow!(
                    "{name}: its colour has {}x{} pixels and its raw depth {}x{}; register depth to colour",
                    color_size.0,
                    color_size.1,
                    size.0,
                    size.1
                )));
            }
            let mut out = vec![0f32; depth.pixels.len()];
            let mut job = Job {
                color: Color {
                    pixels: color.as_raw(),
                    format: ColorFormat::Rgb8,
                    width: size.0,
                    height: size.1,
                    stride: 3 * size.0,
                },
                depth,
                out: Output::Metres(&mut out),
                steps: StepTimes::default(),
            };
            match refiner.refine(core::slice::from_mut(&mut job)) {
                Ok(()) => {}
                Err(e) if matches!(e.kind(), ErrorKind::BadInput | ErrorKind::SizeMismatch) => {
                    return Ok(Err(
                        anyhow::Error::new(e).context(format!("{name}: {} cannot refine it", row.info.name))
                    ));
                }
                Err(e) => bail!(anyhow::Error::new(e).context(format!("{name}: {} failed", row.info.name))),
            }
            image.predictions.push((first + k, Metres { width: size.0, height: size.1, pixels: out }));
        }
        Ok(Ok(image))
    }
}

impl Row {
    fn open(choice: &Choice, options: &RunOptions) -> Result<Self> {
        let input = if choice.filled { FILLED } else { HOLED };
        let info = |engine: &str, model: &str| RowInfo {
            name: choice.name.clone(),
            input: input.into(),
            engine: engine.into(),
            model: model.into(),
        };
        if choice.what == FILLED {
            let info = RowInfo { input: FILLED.into(), ..info("", "") };
            return Ok(Self { info, filled: true, refiner: None });
        }
        let engine = choice.what.parse::<EngineKind>();
        let store = || ModelStore::open(options.models.as_deref());
        let file = Path::new(&choice.what);
        let tiny = is_tiny_file(file).then(|| TinyFile::read(file)).transpose()?;
        let model = match &engine {
            Ok(_) => None,
            Err(_) if tiny.is_some() => None,
            Err(unknown) => Some(store().and_then(|s| s.model(&choice.what)).map_err(|e| {
                // A name may have been meant as either.
                let said = if e.kind() == ErrorKind::NotFound {
                    format!("{e}; {unknown}, or {FILLED}")
                } else {
                    e.to_string()
                };
                anyhow::Error::msg(said)
            })?),
        };
        let refiner = depthrig_cdm::refiner(&RefinerOptions {
            engine: engine.ok().or_else(|| tiny.is_some().then_some(EngineKind::Tiny)),
            model,
            tiny,
            input_size: options.input_size,
            precision: options.precision,
            device: options.device.clone(),
            threads: options.threads,
            library: options.library.clone(),
            ..RefinerOptions::default()
        })
        .map_err(usage)?;
        let d = refiner.describe();
        Ok(Self { info: info(&d.engine, &d.model), filled: choice.filled, refiner: Some(refiner) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refiner_is_named_by_what_it_is_unless_it_has_a_name() {
        let choice =
            |name: &str, what: &str, filled| Ok(Choice { name: name.into(), what: what.into(), filled });
        assert_eq!(Choice::parse("fill"), choice("fill", "fill", false));
        assert_eq!(Choice::parse("cdm-d435:filled"), choice("cdm-d435 (filled)", "cdm-d435", true));
        assert_eq!(Choice::parse("cdm-d435:holed"), choice("cdm-d435", "cdm-d435", false));
        assert_eq!(Choice::parse("mine=runs/a:b.pt:filled"), choice("mine", "runs/a:b.pt", true));
        for bad in ["", "=fill", ":filled", "a="] {
            assert!(Choice::parse(bad).unwrap_err().contains("fill or cdm-d435:filled"), "{bad}");
        }
    }
}
