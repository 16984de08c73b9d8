//! One part becomes a table of its own and the statistics of what is in it.

use super::stats::{ImageStats, NumberStats, sampled};
use super::table::{Kind, TableWriter, Values, text};
use super::{columns, encode};
use crate as exchange;
use crate::rows::plan::{Episode, Plan};
use crate::{PartOut, PartSets, Source};
use depthrig_recorder::{DatasetSet, Error, ErrorKind, PixelMode, Result};
use parquet::data_type::ByteArray;
use serde::{Deserialize, Serialize};

/// A row group is written when its images take this much: it is held in memory.
const ROW_GROUP_BYTES: usize = 48 << 20;

/// Size and statistics of a part, for the end of the export.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct PartInfo {
    pub(super) rows: u64,
    pub(super) bytes: u64,
    /// By feature.
    pub(super) images: Vec<ImageStats>,
    /// By column of `columns::numbers`.
    pub(super) numbers: Vec<NumberStats>,
}

/// The table of a part, until its episode's data file is complete.
pub(super) fn table_name(part: &exchange::Part) -> String {
    format!(".part_{:05}_{:08}.parquet", part.source, part.sets.start)
}

/// Makes the table of a part. A set that cannot be read becomes a row of blank images, so that every row stays where
/// the plan has it.
pub(super) fn write(
    plan: &Plan,
    source: &Source,
    part: &exchange::Part,
    sets: &mut PartSets<'_>,
    out: &mut PartOut<'_>,
) -> Result<()> {
    let name = table_name(part);
    let table = TableWriter::new(out.scratch(&name)?, &name, &columns::layout(&plan.schema))?;
    let mut rows = Rows::new(plan, part.source, table);
    let place = plan.schema.places(source);
    let mut next = part.sets.start;
    loop {
        let set = sets.next(PixelMode::Stored, out)?;
        let until = set.as_ref().map_or(part.sets.end, |(number, _)| *number);
        for number in next..until {
            rows.unreadable(number, source)?;
        }
        let Some((number, set)) = set else { break };
        next = number + 1;
        rows.set(number, &set, &place, out)?;
    }
    let info = rows.finish()?;
    *out.rows() = serde_json::to_vec(&info)
        .map_err(|e| Error::new(ErrorKind::BadInput, "statistics cannot be written").with_source(e))?;
    Ok(())
}

/// A value of a number column.
#[derive(Debug, Clone, Copy)]
enum Number {
    Int(i64),
    /// The capture time of a frame that is not there: 0, and not in the statistics.
    None,
    Float(f32),
    Bool(bool),
}

impl Number {
    fn value(self) -> f64 {
        match self {
            Self::Int(v) => v as f64,
            Self::None => 0.0,
            Self::Float(v) => f64::from(v),
            Self::Bool(v) => f64::from(u8::from(v)),
        }
    }
}

/// Time and identity of a set.
struct SetFacts {
    utc_ns: i64,
    set_id: i64,
    spread_ns: i64,
}

impl SetFacts {
    fn of(set: &DatasetSet) -> Self {
        let utc_ns = set.tick.ns().saturating_add(set.utc_offset_ns);
        Self { utc_ns, set_id: set.id as i64, spread_ns: set.spread_ns }
    }
}

/// Rows on their way into a table.
struct Rows<'p, 'f> {
    plan: &'p Plan,
    episode: &'p Episode,
    episode_index: usize,
    table: TableWriter<'f>,
    /// By feature: images and their names of the row group in the making.
    images: Vec<(Vec<ByteArray>, Vec<ByteArray>)>,
    /// By column of `columns::numbers`.
    numbers: Vec<Vec<Number>>,
    /// By vector.
    vectors: Vec<Vec<Vec<f32>>>,
    group_bytes: usize,
    /// A blank image of each feature, made when it is needed first.
    blanks: Vec<Option<(ByteArray, &'static str)>>,
    info: PartInfo,
}

impl<'p, 'f> Rows<'p, 'f> {
    fn new(plan: &'p Plan, episode_index: usize, table: TableWriter<'f>) -> Self {
        let features = plan.schema.features.len();
        let numbers = columns::numbers(&plan.schema).len();
        Self {
            plan,
            episode: &plan.episodes[episode_index],
            episode_index,
            table,
            images: vec![(Vec::new(), Vec::new()); features],
            numbers: vec![Vec::new(); numbers],
            vectors: vec![Vec::new(); plan.schema.vectors.len()],
            group_bytes: 0,
            blanks: vec![None; features],
            info: PartInfo {
                rows: 0,
                bytes: 0,
                images: vec![ImageStats::default(); features],
                numbers: vec![NumberStats::default(); numbers],
            },
        }
    }

    /// The row of a set whose images cannot be read. Its numbers mostly can, because they lie elsewhere.
    fn unreadable(&mut self, number: usize, source: &Source) -> Result<()> {
        let Some(row) = self.episode.row_of(number) else { return Ok(()) };
        let facts = match source.reader().read(number, PixelMode::None) {
            Ok(set) => SetFacts::of(&set),
            Err(e) if e.kind() == ErrorKind::Io => return Err(e),
            Err(_) => SetFacts { utc_ns: source.times()[number], set_id: 0, spread_ns: 0 },
        };
        for feature in 0..self.images.len() {
            self.blank(feature, row)?;
        }
        self.end_row(row, number, &facts, &vec![None; self.images.len()])
    }

    fn set(
        &mut self,
        number: usize,
        set: &DatasetSet,
        place: &[Option<usize>],
        out: &mut PartOut<'_>,
    ) -> Result<()> {
        let Some(row) = self.episode.row_of(number) else {
            out.leave_out();
            return Ok(());
        };
        let sample = sampled(row, self.episode.rows);
        let mut captures = vec![None; self.images.len()];
        for (feature, capture) in captures.iter_mut().enumerate() {
            let frame = set.frames.iter().find(|f| place.get(f.stream).copied().flatten() == Some(feature));
            let Some(frame) = frame else {
                self.blank(feature, row)?;
                continue;
            };
            let form = self.plan.schema.features[feature].form;
            match encode::encode(form, frame, sample) {
                Ok((image, samples)) => {
                    if let Some(samples) = samples {
                        self.info.images[feature].add(form.channels(), &samples);
                    }
                    *capture = Some(frame.header.capture_time_ns.saturating_add(set.utc_offset_ns));
                    self.image(feature, row, image.bytes.into(), image.extension);
                    out.frame(frame.stream);
                }
                Err(e) => {
                    out.lose(e.to_string());
                    self.blank(feature, row)?;
                }
            }
        }
        self.end_row(row, number, &SetFacts::of(set), &captures)
    }

    fn blank(&mut self, feature: usize, row: u64) -> Result<()> {
        let f = &self.plan.schema.features[feature];
        let (bytes, extension) = if let Some(blank) = &self.blanks[feature] {
            blank.clone()
        } else {
            let blank = encode::blank(f.form, f.width, f.height)?;
            self.blanks[feature].insert((blank.bytes.into(), blank.extension)).clone()
        };
        self.image(feature, row, bytes, extension);
        Ok(())
    }

    fn image(&mut self, feature: usize, row: u64, bytes: ByteArray, extension: &str) {
        self.group_bytes += bytes.len();
        let (images, names) = &mut self.images[feature];
        images.push(bytes);
        names.push(text(format!("frame-{row:06}.{extension}")));
    }

    /// The numbers of a row, in the order of `columns::numbers`, and its vectors.
    fn end_row(&mut self, row: u64, number: usize, facts: &SetFacts, captures: &[Option<i64>]) -> Result<()> {
        let fixed = [
            // The loader works in floats, and computes the grid as this quotient.
            Number::Float((row as f64 / self.plan.fps) as f32),
            Number::Int(row as i64),
            Number::Int(self.episode_index as i64),
            Number::Int((self.episode.first_row + row) as i64),
            Number::Int(self.episode.task as i64),
            Number::Int(facts.utc_ns),
            Number::Int(facts.set_id),
            Number::Int(facts.spread_ns),
        ];
        let times = captures.iter().map(|c| c.map_or(Number::None, Number::Int));
        let missing = captures.iter().map(|c| Number::Bool(c.is_none()));
        let schema = &self.plan.schema;
        let moments = &self.episode.moments;
        let masks = schema.masks().enumerate();
        let masks = masks.map(|(v, _)| Number::Bool(moments.row(v, number).is_none_or(|r| r.is_missing)));
        let is_last = row + 1 == self.episode.rows;
        let success = schema.is_judged().then_some(Number::Bool(is_last && self.episode.is_success));
        let values = fixed.into_iter().chain(times).chain(missing).chain(masks).chain(success);
        for ((column, stats), value) in self.numbers.iter_mut().zip(&mut self.info.numbers).zip(values) {
            if !matches!(value, Number::None) {
                stats.add(value.value(), row, self.episode.rows);
            }
            column.push(value);
        }
        for (v, rows) in self.vectors.iter_mut().enumerate() {
            rows.push(moments.row(v, number).map(|r| r.values.clone()).unwrap_or_default());
        }
        self.info.rows += 1;
        if self.group_bytes >= ROW_GROUP_BYTES { self.end_group() } else { Ok(()) }
    }

    fn end_group(&mut self) -> Result<()> {
        if self.numbers.first().is_none_or(Vec::is_empty) {
            return Ok(());
        }
        let mut values = Vec::with_capacity(self.images.len() + self.numbers.len() + self.vectors.len());
        for (bytes, paths) in &mut self.images {
            values.push(Values::Image { bytes: std::mem::take(bytes), paths: std::mem::take(paths) });
        }
        for ((_, kind), column) in columns::numbers(&self.plan.schema).iter().zip(&mut self.numbers) {
            values.push(column_values(*kind, &std::mem::take(column)));
        }
        for rows in self.vectors.iter_mut().map(std::mem::take) {
            let is_single = rows.iter().all(|r| r.len() == 1);
            values.push(if is_single { Values::Float32(rows.concat()) } else { Values::Floats(rows) });
        }
        self.group_bytes = 0;
        self.table.rows(&values)
    }

    fn finish(mut self) -> Result<PartInfo> {
        self.end_group()?;
        let bytes = self.table.close()?;
        Ok(PartInfo { bytes, ..self.info })
    }
}

fn column_values(kind: Kind, values: &[Number]) -> Values {
    match kind {
        Kind::Bool => Values::Bool(values.iter().map(|v| matches!(v, Number::Bool(true))).collect()),
        Kind::Float32 => Values::Float32(values.iter().map(|v| v.value() as f32).collect()),
        _ => Values::Int64(values.iter().map(|v| if let Number::Int(i) = v { *i } else { 0 }).collect()),
    }
}
