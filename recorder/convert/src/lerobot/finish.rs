//! Parts become the data files and the metadata of a LeRobot dataset.

use super::columns::{self, Ordered, image_key};
use super::part::{self, PartInfo};
use super::stats::{ImageStats, NumberStats, QUANTILES, Stats};
use super::table::{Kind, Layout, Table, TableWriter, Values, text};
use crate::rows::plan::Plan;
use crate::rows::schema::calibration;
use crate::{Output, Parts, Source};
use depthrig_recorder::{Error, ErrorKind, Result};
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// LeRobot's own limits (`datasets/utils.py`): files per folder, MiB per data file and per video file.
const FILES_PER_CHUNK: usize = 1000;
const DATA_FILE_MB: u64 = 100;
const VIDEO_FILE_MB: u64 = 200;
/// The version of LeRobot's format.
const CODEBASE_VERSION: &str = "v3.0";
const DATA_PATH: &str = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet";

/// The parts of an episode put together.
struct Whole {
    bytes: u64,
    file: usize,
    /// By feature, by number column and by vector; none where nothing was seen.
    stats: Vec<Option<Stats>>,
}

/// Puts the parts together below `out`.
pub(super) fn finish(plan: &Plan, sources: &[Source], parts: &Parts<'_>, out: &Output<'_>) -> Result<()> {
    let mut episodes = Vec::with_capacity(plan.episodes.len());
    for source in 0..sources.len() {
        episodes.push(gather(plan, sources, source, parts)?);
    }
    place(&mut episodes);
    for file in 0..episodes.last().map_or(0, |e| e.file + 1) {
        data_file(plan, parts, out, file, &episodes)?;
    }
    metadata(plan, sources, out, &episodes)
}

/// Adds up what is known of an episode's parts.
fn gather(plan: &Plan, sources: &[Source], source: usize, parts: &Parts<'_>) -> Result<Whole> {
    let schema = &plan.schema;
    let numbers = columns::numbers(schema);
    let mut images = vec![ImageStats::default(); schema.features.len()];
    let mut columns = vec![NumberStats::default(); numbers.len()];
    let mut bytes = 0;
    for part in parts.rows(source) {
        let part: PartInfo = serde_json::from_slice(&part?).map_err(|e| {
            let what = "the marks of a part are not as depthrig wrote them; export into a new folder";
            Error::new(ErrorKind::Corrupt, what).with_source(e)
        })?;
        bytes += part.bytes;
        images.iter_mut().zip(&part.images).for_each(|(to, from)| to.merge(from));
        columns.iter_mut().zip(&part.numbers).for_each(|(to, from)| to.merge(from));
    }
    let of_images = images.iter().zip(&schema.features).map(|(s, f)| s.finish(columns::divisor(f.form)));
    let of_columns = columns.iter().zip(&numbers).map(|(s, (name, _))| s.finish(columns::ordered(name)));
    let episode = &plan.episodes[source];
    let numbers = sources[source].numbers().filter(|n| episode.row_of(*n).is_some());
    let numbers: Vec<_> = numbers.collect();
    let of_vectors = (0..schema.vectors.len()).map(|v| {
        let rows = numbers.iter().filter_map(|n| episode.moments.row(v, *n)).filter(|r| !r.is_missing);
        Stats::of_vectors(&rows.map(|r| r.values.as_slice()).collect::<Vec<_>>())
    });
    Ok(Whole { bytes, file: 0, stats: of_images.chain(of_columns).chain(of_vectors).collect() })
}

/// Decides which file each episode goes into: a file is full when the next episode would exceed the limit. An
/// episode is never split, because `meta/episodes` can name only one file for it; so a long one makes a long file.
fn place(episodes: &mut [Whole]) {
    let mut file = 0;
    let mut size = 0;
    for e in episodes {
        if size > 0 && size + e.bytes > DATA_FILE_MB << 20 {
            (file, size) = (file + 1, 0);
        }
        size += e.bytes;
        e.file = file;
    }
}

fn chunk_folder(file: usize) -> String {
    format!("data/chunk-{:03}", file / FILES_PER_CHUNK)
}

/// Writes one data file from the tables of its parts, which are removed then. One that is there already is complete.
fn data_file(
    plan: &Plan,
    parts: &Parts<'_>,
    out: &Output<'_>,
    file: usize,
    episodes: &[Whole],
) -> Result<()> {
    let folder = chunk_folder(file);
    let name = format!("{folder}/file-{:03}.parquet", file % FILES_PER_CHUNK);
    let tables =
        || parts.iter().filter(|(p, _)| episodes[p.source].file == file).map(|(p, _)| part::table_name(p));
    let here = plan.episodes.iter().zip(episodes).filter(|(_, e)| e.file == file);
    let rows: u64 = here.map(|(e, _)| e.rows).sum();
    let wrong =
        |what: String| Err(Error::new(ErrorKind::Corrupt, format!("{what}; export into a new folder")));
    if let Some(table) = Table::open(out, &name)? {
        let found = table.rows()?;
        if found != rows {
            return wrong(format!("{name} has {found} rows where {rows} were planned"));
        }
        out.keep(table.bytes);
    } else {
        out.folder(&folder)?;
        let mut data = TableWriter::new(out.create(&name)?, &name, &columns::layout(&plan.schema))?;
        let mut written = 0;
        for table in tables() {
            let Some(table) = Table::open(out, &table)? else {
                return wrong(format!("{} has lost {table}", out.dir().display()));
            };
            written += data.append(&table)?;
        }
        if written != rows {
            return wrong(format!("{name} would have {written} rows where {rows} were planned"));
        }
        data.close()?;
        out.sync_dir(&out.dir().join(&folder))?;
    }
    tables().try_for_each(|table| out.remove(&table))
}

/// Writes the folder `meta` and the calibration. `info.json` comes last: without it nobody takes the folder for
/// a LeRobot dataset.
fn metadata(plan: &Plan, sources: &[Source], out: &Output<'_>, episodes: &[Whole]) -> Result<()> {
    write_json(out, "calibration.json", &calibrations(plan, sources))?;
    tasks(plan, out)?;
    episode_table(plan, episodes, out)?;
    let names = column_names(plan);
    let mut stats = BTreeMap::new();
    for (i, name) in names.iter().enumerate() {
        let all: Vec<&Stats> = episodes.iter().filter_map(|e| e.stats[i].as_ref()).collect();
        if let Some(s) = Stats::aggregate(&all) {
            stats.insert(name.clone(), s.to_json(i < plan.schema.features.len()));
        }
    }
    write_json(out, "meta/stats.json", &stats)?;
    write_json(out, "meta/info.json", &info(plan, sources))
}

/// Features, number columns and vectors: the order of `Whole::stats`.
fn column_names(plan: &Plan) -> Vec<String> {
    let images = plan.schema.features.iter().map(image_key);
    let numbers = columns::numbers(&plan.schema).into_iter().map(|(name, _)| name);
    let vectors = plan.schema.vectors.iter().map(|v| v.key.to_owned());
    images.chain(numbers).chain(vectors).collect()
}

#[derive(Serialize)]
struct Info {
    codebase_version: &'static str,
    robot_type: String,
    total_episodes: usize,
    total_frames: u64,
    total_tasks: usize,
    chunks_size: usize,
    data_files_size_in_mb: u64,
    video_files_size_in_mb: u64,
    fps: Value,
    splits: BTreeMap<&'static str, String>,
    data_path: &'static str,
    video_path: Option<&'static str>,
    features: Ordered<Value>,
}

fn info(plan: &Plan, sources: &[Source]) -> Info {
    let fps = plan.fps;
    Info {
        codebase_version: CODEBASE_VERSION,
        robot_type: sources.first().map_or_else(String::new, |s| s.session().rig.clone()),
        total_episodes: plan.episodes.len(),
        total_frames: plan.rows(),
        total_tasks: plan.tasks.len(),
        chunks_size: FILES_PER_CHUNK,
        data_files_size_in_mb: DATA_FILE_MB,
        video_files_size_in_mb: VIDEO_FILE_MB,
        // LeRobot's type is a whole number; it computes with others just as well.
        fps: if fps.fract() == 0.0 { json!(fps as i64) } else { json!(fps) },
        splits: BTreeMap::from([("train", format!("0:{}", plan.episodes.len()))]),
        data_path: DATA_PATH,
        video_path: None,
        features: columns::features_json(&plan.schema, sources),
    }
}

/// Intrinsics, poses and units, which LeRobot has no place for per episode.
fn calibrations(plan: &Plan, sources: &[Source]) -> Value {
    let episodes = sources.iter().enumerate().map(|(index, source)| {
        let session = source.session();
        let streams = plan.schema.features.iter().filter_map(|feature| {
            let s = session.streams.iter().find(|s| s.id == feature.id)?;
            let mut entry = json!({
                "feature": image_key(feature),
                "stream": s.id.to_string(),
                "model": s.model,
                "width": s.width,
                "height": s.height,
                "depth_unit_m": s.depth_unit_m,
            });
            for (key, value) in calibration(s) {
                entry[key] = value;
            }
            Some(entry)
        });
        let mut entry =
            json!({ "episode_index": index, "session": session.name, "streams": streams.collect::<Vec<_>>() });
        if let Some(episode) = source.episode() {
            entry["episode"] = json!(episode);
        }
        entry
    });
    json!({ "format": "depthrig.lerobot_calibration/1", "episodes": episodes.collect::<Vec<_>>() })
}

/// The tasks, as a table that pandas opens with the task as its index: LeRobot looks them up by it.
fn tasks(plan: &Plan, out: &Output<'_>) -> Result<()> {
    let column = |name: &str, pandas: &str, numpy: &str| json!({ "name": name, "field_name": name, "pandas_type": pandas, "numpy_type": numpy, "metadata": null });
    let pandas = json!({
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": { "library": "depthrig", "version": env!("CARGO_PKG_VERSION") },
        "pandas_version": "2.0.0",
    });
    let layout = Layout {
        columns: vec![("task_index".to_owned(), Kind::Int64), ("task".to_owned(), Kind::Text)],
        footer: vec![("pandas", pandas.to_string())],
    };
    let indices = (0..plan.tasks.len() as i64).collect();
    let names = plan.tasks.iter().map(text).collect();
    write_table(out, "meta/tasks.parquet", &layout, &[Values::Int64(indices), Values::Text(names)])
}

/// A row per episode: where its rows are, and its statistics.
fn episode_table(plan: &Plan, episodes: &[Whole], out: &Output<'_>) -> Result<()> {
    let ints = |f: &dyn Fn(usize) -> u64| Values::Int64((0..episodes.len()).map(|e| f(e) as i64).collect());
    let file = |e: usize| episodes[e].file;
    let task = |e: usize| vec![text(&plan.tasks[plan.episodes[e].task])];
    let mut columns: Vec<(String, Kind, Values)> = vec![
        ("episode_index".to_owned(), Kind::Int64, ints(&|e| e as u64)),
        ("tasks".to_owned(), Kind::TextList, Values::TextList((0..episodes.len()).map(task).collect())),
        ("length".to_owned(), Kind::Int64, ints(&|e| plan.episodes[e].rows)),
        ("data/chunk_index".to_owned(), Kind::Int64, ints(&|e| (file(e) / FILES_PER_CHUNK) as u64)),
        ("data/file_index".to_owned(), Kind::Int64, ints(&|e| (file(e) % FILES_PER_CHUNK) as u64)),
        ("dataset_from_index".to_owned(), Kind::Int64, ints(&|e| plan.episodes[e].first_row)),
        (
            "dataset_to_index".to_owned(),
            Kind::Int64,
            ints(&|e| plan.episodes[e].first_row + plan.episodes[e].rows),
        ),
        ("meta/episodes/chunk_index".to_owned(), Kind::Int64, ints(&|_| 0)),
        ("meta/episodes/file_index".to_owned(), Kind::Int64, ints(&|_| 0)),
    ];
    for (i, name) in column_names(plan).iter().enumerate() {
        let image = i < plan.schema.features.len();
        let depth = if image { 3 } else { 1 };
        let of = |e: usize| episodes[e].stats[i].as_ref();
        let statistic = |key: &str| -> Values {
            let value = |s: &Stats| s.entries().find(|(k, _)| *k == key).map(|(_, v)| v.to_vec());
            Values::Doubles((0..episodes.len()).map(|e| of(e).and_then(value)).collect())
        };
        for key in ["min", "max", "mean", "std"].into_iter().chain(QUANTILES.map(|(q, _)| q)) {
            let values = statistic(key);
            let known = matches!(&values, Values::Doubles(rows) if rows.iter().any(Option::is_some));
            if known {
                columns.push((format!("stats/{name}/{key}"), Kind::Doubles { depth }, values));
            }
        }
        let counts = (0..episodes.len()).map(|e| of(e).map(|s| vec![s.count as i64])).collect();
        columns.push((format!("stats/{name}/count"), Kind::Int64List, Values::Int64List(counts)));
    }
    let layout =
        Layout { columns: columns.iter().map(|(n, k, _)| (n.clone(), *k)).collect(), footer: Vec::new() };
    let values: Vec<_> = columns.into_iter().map(|(_, _, v)| v).collect();
    write_table(out, "meta/episodes/chunk-000/file-000.parquet", &layout, &values)
}

fn write_table(out: &Output<'_>, name: &str, layout: &Layout, columns: &[Values]) -> Result<()> {
    let mut table = TableWriter::new(out.create(name)?, name, layout)?;
    table.rows(columns)?;
    table.close().map(drop)
}

fn write_json<T: Serialize>(out: &Output<'_>, name: &str, value: &T) -> Result<()> {
    let text = serde_json::to_vec_pretty(value)
        .map_err(|e| Error::new(ErrorKind::BadInput, format!("{name} cannot be written")).with_source(e))?;
    out.file(name, &text)
}
