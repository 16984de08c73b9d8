//! Shards of `depthrig scenes`: tar files with samples (docs/depth-lab.md).

use super::files::RAW;
use super::read::{Metres, Raw, png8, png16};
use super::scenes::Scenes;
use super::{Images, Job, Loaded, Place, Source, same_size};
use anyhow::{Context, Result, bail};
use depthrig_bus::{Distortion, Intrinsics, files};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const BLOCK: u64 = 512;
/// The largest member that is read.
const MEMBER_MAX: u64 = 1 << 28;
const FORMAT: u32 = 1;

/// Where a member lies.
#[derive(Debug, Clone, Copy)]
struct Span {
    at: u64,
    len: u64,
}

/// A sample of a shard: its members by name without the key.
#[derive(Debug, Clone)]
struct Sample {
    shard: Arc<PathBuf>,
    members: BTreeMap<String, Span>,
    place: Place,
}

/// The record of a sample.
#[derive(Deserialize)]
struct Facts {
    format: u32,
    #[serde(default)]
    sensor: String,
    #[serde(default)]
    scene: String,
    intrinsics: Option<Lens>,
    truth_unit_m: f64,
    raw_unit_m: f64,
}

#[derive(Deserialize)]
struct Lens {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    #[serde(default)]
    model: Option<Distortion>,
    #[serde(default)]
    coeffs: Vec<f64>,
}

/// The samples of one or more shards.
pub struct Shards {
    names: Vec<String>,
    samples: std::vec::IntoIter<Sample>,
    total: u64,
    left_out: Vec<String>,
}

/// Whether `path` is a shard or has shards in it.
pub fn are_at(path: &Path) -> bool {
    is_tar(path) || path.read_dir().is_ok_and(|entries| entries.flatten().any(|e| is_tar(&e.path())))
}

fn is_tar(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "tar") && path.is_file()
}

impl Shards {
    /// The shard at `path`, or those in that folder; headers are read now.
    ///
    /// # Errors
    /// When one is cut short or not a shard; it is named.
    pub fn open(path: &Path, scenes: &Scenes) -> Result<Self> {
        let mut left_out = Vec::new();
        let paths = if path.is_dir() {
            let entries = path.read_dir().with_context(|| format!("{}: cannot be read", path.display()))?;
            let mut all: Vec<PathBuf> = entries.flatten().map(|e| e.path()).collect();
            let unfinished = all.iter().filter(|p| p.extension().is_some_and(|e| e == "part")).count();
            if unfinished > 0 {
                left_out.push(format!("{unfinished} unfinished shards (.part)"));
            }
            all.retain(|p| is_tar(p));
            all.sort();
            all
        } else {
            vec![path.to_owned()]
        };
        let mut samples = Vec::new();
        for path in paths {
            let shard = Arc::new(path);
            list(&shard, !scenes.is_all(), &mut samples)
                .with_context(|| format!("{}: cannot be read as a shard", shard.display()))?;
        }
        let samples = scenes.keep(samples, |s| &s.place)?;
        if samples.is_empty() {
            bail!("{}: its shards have no samples", path.display());
        }
        let total = samples.len() as u64;
        Ok(Self { names: vec![RAW.to_owned()], samples: samples.into_iter(), total, left_out })
    }
}

impl Source for Shards {
    fn names(&self) -> &[String] {
        &self.names
    }

    fn total(&self) -> u64 {
        self.total
    }

    fn next(&mut self) -> Option<Result<Job>> {
        let sample = self.samples.next()?;
        Some(Ok(Box::new(move || {
            let name = sample.place.name.clone();
            let loaded = read(sample).with_context(|| format!("{name}: cannot be read"))?;
            Ok(Images { loaded: vec![loaded], ..Images::default() })
        })))
    }

    fn left_out(&self) -> Vec<String> {
        self.left_out.clone()
    }
}

/// Adds the samples of a shard to `samples`; their scenes only if they are needed to choose.
fn list(shard: &Arc<PathBuf>, with_scenes: bool, samples: &mut Vec<Sample>) -> Result<()> {
    let mut file = files::open(shard.as_path())?;
    let bytes = file.metadata()?.len();
    let mut at = 0;
    let mut open: BTreeMap<String, Span> = BTreeMap::new();
    let mut open_key = String::new();
    let cut = |at: u64| format!("it is cut short at byte {at}; make this shard again");
    loop {
        let mut head = [0; BLOCK as usize];
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut head).ok().with_context(|| cut(bytes.min(at)))?;
        if head == [0; BLOCK as usize] {
            file.read_exact(&mut head)
                .ok()
                .filter(|()| head == [0; BLOCK as usize])
                .with_context(|| cut(at))?;
            break;
        }
        let Header { name, len, is_file } =
            header(&head).with_context(|| format!("no tar header at byte {at}; make this shard again"))?;
        at += BLOCK;
        let span = Span { at, len };
        at += len.next_multiple_of(BLOCK);
        if at > bytes {
            bail!("{}", cut(bytes));
        }
        if !is_file {
            continue;
        }
        let (key, what) = name.split_once('.').with_context(|| format!("unknown member {name}"))?;
        if !open.is_empty() && key != open_key {
            bail!("sample {open_key} has no json at its end");
        }
        key.clone_into(&mut open_key);
        if open.insert(what.to_owned(), span).is_some() {
            bail!("{name} is there twice");
        }
        if what == "json" {
            let members = std::mem::take(&mut open);
            for needed in ["color.png", "truth.png", "raw.png"] {
                if !members.contains_key(needed) {
                    bail!("sample {key} has no {needed}");
                }
            }
            let place = Place {
                name: format!("{} {key}", shard.file_name().unwrap_or_default().display()),
                scene: String::new(),
                sequence: key.to_owned(),
            };
            let mut sample = Sample { shard: Arc::clone(shard), members, place };
            if with_scenes {
                sample.place.scene = facts(&mut file, &sample)?.scene;
            }
            samples.push(sample);
        }
    }
    if !open.is_empty() {
        bail!("sample {open_key} has no json at its end");
    }
    Ok(())
}

struct Header {
    name: String,
    len: u64,
    is_file: bool,
}

/// The header of a member (POSIX.1-1988 ustar); `None` when its checksum is wrong.
fn header(head: &[u8; BLOCK as usize]) -> Option<Header> {
    let text = |span: core::ops::Range<usize>| {
        let field = head[span].split(|b| *b == 0).next()?;
        core::str::from_utf8(field).ok().map(str::trim)
    };
    let number = |span| u64::from_str_radix(text(span)?, 8).ok();
    let sum: u64 =
        head.iter().enumerate().map(|(i, b)| if (148..156).contains(&i) { 32 } else { u64::from(*b) }).sum();
    let len = number(124..136)?;
    (number(148..156)? == sum && len <= MEMBER_MAX).then_some(())?;
    Some(Header { name: text(0..100)?.to_owned(), len, is_file: matches!(head[156], b'0' | 0) })
}

fn member(file: &mut File, sample: &Sample, name: &str) -> Result<Option<Vec<u8>>> {
    let Some(span) = sample.members.get(name) else { return Ok(None) };
    file.seek(SeekFrom::Start(span.at))?;
    let mut bytes = vec![0; usize::try_from(span.len)?];
    file.read_exact(&mut bytes)?;
    Ok(Some(bytes))
}

fn needed(file: &mut File, sample: &Sample, name: &str) -> Result<Vec<u8>> {
    member(file, sample, name)?.with_context(|| format!("it has no {name}"))
}

fn facts(file: &mut File, sample: &Sample) -> Result<Facts> {
    let bytes = needed(file, sample, "json")?;
    let facts: Facts = serde_json::from_slice(&bytes)
        .with_context(|| format!("invalid json of {}", sample.place.sequence))?;
    if facts.format != FORMAT {
        bail!("format {}, and this program reads {FORMAT}; install a later depthrig", facts.format);
    }
    for unit in [facts.truth_unit_m, facts.raw_unit_m] {
        if !(1e-6..=1.0).contains(&unit) {
            bail!("invalid depth unit {unit} m");
        }
    }
    Ok(facts)
}

fn read(sample: Sample) -> Result<Loaded> {
    let mut file = files::open(sample.shard.as_path())?;
    let facts = facts(&mut file, &sample)?;
    let ((width, height), truth) = png16(&needed(&mut file, &sample, "truth.png")?).context("truth.png")?;
    let pixels = truth.iter().map(|v| (f64::from(*v) * facts.truth_unit_m) as f32).collect();
    let truth = Metres { width, height, pixels };
    let (size, pixels) = png16(&needed(&mut file, &sample, "raw.png")?).context("raw.png")?;
    same_size("raw.png", size, &truth)?;
    let raw = Raw { width, height, pixels, unit_m: facts.raw_unit_m };
    let color = needed(&mut file, &sample, "color.png")?;
    let color = image::load_from_memory_with_format(&color, image::ImageFormat::Png).context("color.png")?;
    let color = color.into_rgb8();
    same_size("color.png", (color.width() as usize, color.height() as usize), &truth)?;
    let material = match member(&mut file, &sample, "material.png")? {
        Some(bytes) => {
            let (size, numbers) = png8(&bytes).context("material.png")?;
            same_size("material.png", size, &truth)?;
            Some(Arc::new(numbers))
        }
        None => None,
    };
    let lens = facts.intrinsics.map(|l| {
        let mut lens = Intrinsics::pinhole(l.fx, l.fy, l.cx, l.cy);
        lens.model = l.model.unwrap_or(Distortion::None) as u32;
        for (to, from) in lens.coeffs.iter_mut().zip(l.coeffs) {
            *to = from;
        }
        lens
    });
    Ok(Loaded {
        group: facts.sensor,
        place: Place { scene: facts.scene, ..sample.place },
        truth: Arc::new(truth),
        predictions: Vec::new(),
        raw: Some((0, raw)),
        color: Some(Arc::new(color)),
        material,
        lens,
    })
}
