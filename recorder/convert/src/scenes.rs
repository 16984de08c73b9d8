//! Random scenes as shards of training data: tar files in the layout of `WebDataset`.
//!
//! [`write`] makes the shards of a part of a run. A shard has its name only when it is complete and durable, a complete shard
//! is left alone, and sample `i` depends on the run's arguments and `i` alone: so a run that was killed goes on where
//! it was, and any part can be made on any computer with the same bytes.

use crate::RunPart;
use crate::store::{Place, Remote};
use core::sync::atomic::{AtomicU64, Ordering};
use depthrig_bus::HostTime;
use depthrig_bus::clock::process_cpu_ns;
use depthrig_recorder::{Error, ErrorKind, Result};
use depthrig_sim::synthetic::scenes::{Generator, Sensor, TriangleMesh, Triplet};
use serde::Serialize;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

mod dataset;
mod sample;
mod tar;
mod world;

pub use dataset::SceneSets;
pub use sample::contact_sheet;
pub use world::write_world;

/// Version of the layout.
pub const FORMAT: u32 = 1;
/// Goes up when the generator makes other samples of the same arguments.
const GENERATOR: u32 = 3;
/// Samples that a thread makes between two writes.
const BATCH: usize = 8;

/// A part of a run.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Folder of the shards; made when missing.
    pub folder: PathBuf,
    /// Where each shard goes from there, if they go to a bucket.
    pub remote: Option<Remote>,
    /// First part of the shards' names.
    pub name: String,
    /// Samples of the whole run.
    pub count: u64,
    /// Samples of a shard.
    pub per_shard: u64,
    /// This part: of the shards.
    pub part: RunPart,
    /// Threads.
    pub threads: usize,
}

/// Account of the work.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Report {
    /// Shards of this part.
    pub shards: u64,
    /// Shards of this part that were whole before.
    pub shards_found: u64,
    /// Shards of this part that are missing at the end.
    pub shards_missing: u64,
    /// Samples made now.
    pub samples: u64,
    /// Bytes written now.
    pub bytes: u64,
    /// Time on the clock, seconds.
    pub seconds: f64,
    /// CPU time of the process, seconds.
    pub cpu_seconds: f64,
    /// Samples for each CPU second; 0 when none was made.
    pub samples_per_core_second: f64,
}

impl Plan {
    /// Shards of the whole run.
    pub const fn shards(&self) -> u64 {
        self.count.div_ceil(self.per_shard)
    }

    /// Path of a shard.
    pub fn path(&self, shard: u64) -> PathBuf {
        self.folder.join(self.file(shard))
    }

    /// Whether a shard is there and complete; an object is complete or not there.
    fn is_whole(&self, shard: u64) -> Result<bool> {
        match &self.remote {
            None => Ok(tar::is_whole(&self.path(shard), self.samples(shard))),
            Some(remote) => Ok(remote.size(&self.file(shard))?.is_some()),
        }
    }

    /// Moves a complete shard to the bucket. If another machine has put it meanwhile, that one stays: it has the same bytes.
    fn hand_over(&self, shard: u64) -> Result<()> {
        let Some(remote) = &self.remote else { return Ok(()) };
        let path = self.path(shard);
        remote.put_file(&path, &self.file(shard))?;
        std::fs::remove_file(&path).map_err(|e| Error::io("remove", &path, e))
    }

    /// Name of a shard's file.
    fn file(&self, shard: u64) -> String {
        format!("{}-{shard:06}.tar", self.name)
    }

    /// Numbers of the samples in a shard.
    const fn samples(&self, shard: u64) -> core::ops::Range<u64> {
        let first = shard * self.per_shard;
        let end = first + self.per_shard;
        first..if end < self.count { end } else { self.count }
    }
}

/// Makes the shards of a part that are missing. `progress` gets the samples done and to do, and ends the work by returning
/// false; the report then counts missing shards.
///
/// # Errors
/// [`ErrorKind::BadInput`] for an impossible plan, and when the folder has a run of this name with other arguments;
/// [`ErrorKind::InUse`] when another process makes the same shard; those of the file system. No half shard has a shard's
/// name then.
pub fn write(
    generator: &Generator,
    plan: &Plan,
    progress: &mut dyn FnMut(u64, u64) -> bool,
) -> Result<Report> {
    check(plan)?;
    depthrig_bus::umask::create_dir_all(&plan.folder)
        .map_err(|e| Error::io("create the folder", &plan.folder, e))?;
    record(generator, plan)?;
    let start = HostTime::now();
    let cpu = process_cpu_ns();
    let mine: Vec<u64> = (0..plan.shards()).filter(|s| plan.part.has(*s)).collect();
    let mut missing = Vec::new();
    for shard in &mine {
        if !plan.is_whole(*shard)? {
            missing.push(*shard);
        }
    }
    let found = mine.len() - missing.len();
    let mut report = Report { shards: mine.len() as u64, shards_found: found as u64, ..Report::default() };
    let length = |s: &u64| plan.samples(*s).end - plan.samples(*s).start;
    let total: u64 = mine.iter().map(length).sum();
    let mut done = total - missing.iter().map(length).sum::<u64>();
    let workers = workers(plan.threads)?;
    report.shards_missing = missing.len() as u64;
    if !progress(done, total) {
        missing.clear();
    }
    for shard in missing {
        match one(generator, plan, shard, &workers, &mut |n| progress(done + n, total))? {
            Made::Ended => break,
            Made::Found => report.shards_found += 1,
            Made::Bytes(bytes) => {
                plan.hand_over(shard)?;
                report.samples += length(&shard);
                report.bytes += bytes;
            }
        }
        done += length(&shard);
        report.shards_missing -= 1;
    }
    report.seconds = start.elapsed().as_secs_f64();
    report.cpu_seconds = (process_cpu_ns() - cpu) as f64 * 1e-9;
    if report.samples > 0 && report.cpu_seconds > 0.0 {
        report.samples_per_core_second = report.samples as f64 / report.cpu_seconds;
    }
    Ok(report)
}

fn check(plan: &Plan) -> Result<()> {
    let bad = |text: String| Err(Error::new(ErrorKind::BadInput, text));
    let is_name = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    if plan.name.is_empty() || plan.name.len() > 64 || !plan.name.chars().all(is_name) {
        return bad(format!("invalid name \"{}\"; use up to 64 letters, digits, - and _", plan.name));
    }
    if plan.count == 0 || plan.count > 9_999_999_999 || plan.per_shard == 0 {
        return bad(format!(
            "invalid count {} or {} samples a shard; counts are 1 to 9999999999",
            plan.count, plan.per_shard
        ));
    }
    if plan.shards() > 1_000_000 {
        return bad(format!("{} shards are too many; put more samples into each", plan.shards()));
    }
    Ok(())
}

/// The arguments of a run: `NAME.json`, the same bytes from every part.
#[derive(Serialize)]
struct Record<'a> {
    format: u32,
    generator: String,
    arguments: Arguments<'a>,
    samples: u64,
    shards: u64,
}

#[derive(Serialize)]
struct Arguments<'a> {
    seed: u64,
    count: u64,
    per_shard: u64,
    cameras: &'a [String],
    sensor: &'static str,
    hide: f32,
    /// Absent at 0: records of runs from before it stay as they are.
    #[serde(skip_serializing_if = "Option::is_none")]
    again: Option<u64>,
    families: Vec<&'static str>,
    width: u32,
    height: u32,
    meshes: usize,
    /// Checksum of the meshes.
    meshes_crc32: u32,
}

fn checksum(meshes: &[TriangleMesh]) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    for mesh in meshes {
        for number in mesh.corners.iter().flatten() {
            sum.update(&number.to_le_bytes());
        }
        for number in mesh.triangles.iter().flatten() {
            sum.update(&number.to_le_bytes());
        }
    }
    sum.finalize()
}

/// Writes `NAME.json`, or checks that the one that is there agrees.
fn record(generator: &Generator, plan: &Plan) -> Result<()> {
    let s = generator.settings();
    let record = Record {
        format: FORMAT,
        generator: format!("depthrig {} scenes {GENERATOR}", env!("CARGO_PKG_VERSION")),
        arguments: Arguments {
            seed: s.seed,
            count: plan.count,
            per_shard: plan.per_shard,
            cameras: &s.cameras,
            sensor: match s.sensor {
                Sensor::Statistical => "statistical",
                Sensor::Stereo => "stereo",
            },
            hide: s.hide,
            again: (s.again > 0).then_some(s.again),
            families: s.families.iter().map(|f| f.name()).collect(),
            width: s.width,
            height: s.height,
            meshes: s.meshes.len(),
            meshes_crc32: checksum(&s.meshes),
        },
        samples: plan.count,
        shards: plan.shards(),
    };
    let name = format!("{}.json", plan.name);
    let place = plan.remote.clone().map_or_else(|| Place::Local(plan.folder.clone()), Place::Remote);
    let mut text = serde_json::to_string_pretty(&record)
        .map_err(|e| Error::new(ErrorKind::BadInput, format!("{place}/{name}: {e}")))?;
    text.push('\n');
    place.agree_on(&name, text.as_bytes(), "give this run another folder or --name")
}

/// Pools of one thread each: a sample is made on one thread, and several at once.
fn workers(threads: usize) -> Result<Vec<rayon::ThreadPool>> {
    let pool = |i| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .thread_name(move |_| format!("scenes-{i}"))
            .build()
            .map_err(|e| Error::new(ErrorKind::Io, format!("a thread cannot be started: {e}")))
    };
    (0..threads.max(1)).map(pool).collect()
}

/// Result for a shard.
enum Made {
    /// It was made, of so many bytes.
    Bytes(u64),
    /// Another process has made it meanwhile.
    Found,
    /// The work was ended before.
    Ended,
}

/// Makes one shard.
fn one(
    generator: &Generator,
    plan: &Plan,
    shard: u64,
    workers: &[rayon::ThreadPool],
    progress: &mut dyn FnMut(u64) -> bool,
) -> Result<Made> {
    let path = plan.path(shard);
    let part = Part::create(&path)?;
    if plan.is_whole(shard)? {
        return Ok(Made::Found);
    }
    let mut out = tar::Tar::new(BufWriter::with_capacity(1 << 20, &part.file));
    let wrote = |e: io::Error| Error::io("write", &path, e);
    let all = plan.samples(shard);
    let first = all.start;
    let mut next = first;
    while next < all.end {
        let batch = next..all.end.min(next + (workers.len() * BATCH) as u64);
        next = batch.end;
        for members in make(generator, batch, workers)? {
            for (name, bytes) in members {
                out.append(&name, &bytes).map_err(wrote)?;
            }
        }
        if !progress(next - first) {
            return Ok(Made::Ended);
        }
    }
    let bytes = out.finish().map_err(wrote)?;
    part.rename(&path).map_err(wrote)?;
    Ok(Made::Bytes(bytes))
}

/// A shard that is being written. Dropped before it got its name, it is removed.
struct Part {
    file: File,
    /// `None` once it was renamed: another process may have this name by then.
    path: Option<PathBuf>,
}

impl Part {
    fn create(shard: &Path) -> Result<Self> {
        let mut name = shard.as_os_str().to_owned();
        name.push(".part");
        let path = PathBuf::from(name);
        let file = crate::open_part(&path).map_err(|e| match e.kind() {
            io::ErrorKind::WouldBlock => {
                let what = format!(
                    "{}: another process makes this shard; give each its own --shard",
                    path.display()
                );
                Error::new(ErrorKind::InUse, what)
            }
            _ => Error::io("create", &path, e),
        })?;
        // One that a killed run left is written anew.
        file.set_len(0).map_err(|e| Error::io("write", &path, e))?;
        Ok(Self { file, path: Some(path) })
    }

    fn rename(mut self, to: &Path) -> io::Result<()> {
        self.file.sync_all()?;
        if let Some(path) = &self.path {
            std::fs::rename(path, to)?;
        }
        self.path = None;
        depthrig_bus::files::sync_folder_of(to)
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        if let Some(path) = &self.path {
            drop(std::fs::remove_file(path));
        }
    }
}

/// The members of each sample of a batch, in order.
fn make(
    generator: &Generator,
    batch: core::ops::Range<u64>,
    workers: &[rayon::ThreadPool],
) -> Result<Vec<sample::Members>> {
    let next = AtomicU64::new(batch.start);
    let work = || {
        let mut made = Vec::new();
        let mut fill = sample::fill()?;
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= batch.end {
                return Ok::<_, Error>(made);
            }
            let triplet = sample_of(generator, number)?;
            made.push((number, sample::members(&triplet, generator.settings(), &mut fill)?));
        }
    };
    let results: Vec<Result<_>> = std::thread::scope(|scope| {
        let threads: Vec<_> = workers.iter().map(|w| scope.spawn(|| w.install(work))).collect();
        let crashed = || Err(Error::new(ErrorKind::Io, "a thread that makes samples crashed"));
        threads.into_iter().map(|t| t.join().unwrap_or_else(|_| crashed())).collect()
    });
    let mut all = Vec::new();
    for result in results {
        all.extend(result?);
    }
    all.sort_unstable_by_key(|(number, _)| *number);
    Ok(all.into_iter().map(|(_, members)| members).collect())
}

/// A sample, or which one could not be made.
fn sample_of(generator: &Generator, number: u64) -> Result<Triplet> {
    generator
        .sample(number)
        .map_err(|e| Error::new(ErrorKind::BadInput, format!("sample {number}: {e}")).with_source(e))
}

#[cfg(test)]
mod tests;
