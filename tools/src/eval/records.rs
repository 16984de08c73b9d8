//! Files of sums: what was measured of each image of a part, to go on with and to merge.
//!
//! Lines of JSON. The first is the [`Header`], then comes a [`Record`] for each image, in order, then the [`End`]. A file that is
//! being written has the ending `.part`; what a killed run left in it is kept but for a last, incomplete line. Sums are text
//! with all their digits: what is read is what was written.

use super::refine::RowInfo;
use super::{Place, Source};
use anyhow::{Context, Result, bail};
use depthrig_bus::files::sync_folder_of;
use depthrig_cdm::metrics::{DepthRange, Measured, Rules};
use depthrig_convert::{RunPart, open_part};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, ErrorKind, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Version of the layout.
const FORMAT: u32 = 2;

/// Arguments of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// [`FORMAT`].
    pub format: u32,
    /// Program that wrote it.
    pub program: String,
    /// The input.
    pub title: String,
    /// This part: of the images.
    pub part: RunPart,
    /// The rows.
    pub rows: Vec<RowInfo>,
    /// [`Rules`] as text: nearest and farthest reference, width of a bin.
    pub metres: [String; 3],
    /// Number of bins.
    pub bins: usize,
    /// As the authors of CDM count.
    pub like_cdm: bool,
    /// Predictions of another size were resized.
    pub resized: bool,
    /// Options that decide what the numbers are, by name.
    pub options: BTreeMap<String, String>,
    /// Jobs of all parts together.
    pub images: u64,
    /// Omissions that were known from the start.
    pub left_out: Vec<String>,
}

impl Header {
    /// Of a run of `rows` over `source`.
    pub fn new(title: &str, part: RunPart, rows: Vec<RowInfo>, rules: &Rules, source: &dyn Source) -> Self {
        Self {
            format: FORMAT,
            program: format!("depthrig {}", env!("CARGO_PKG_VERSION")),
            title: title.to_owned(),
            part,
            rows,
            metres: [rules.range.min_m, rules.range.max_m, rules.bin_m].map(|m| m.to_string()),
            bins: rules.bins,
            like_cdm: rules.skip_not_finite,
            resized: false,
            options: BTreeMap::new(),
            images: source.total(),
            left_out: source.left_out(),
        }
    }

    /// Rules of the measurement.
    ///
    /// # Errors
    /// When a number is damaged.
    pub fn rules(&self) -> Result<Rules> {
        let number = |i: usize| {
            self.metres[i].parse::<f64>().with_context(|| format!("invalid number {}", self.metres[i]))
        };
        Ok(Rules {
            range: DepthRange { min_m: number(0)?, max_m: number(1)? },
            bin_m: number(2)?,
            bins: self.bins,
            skip_not_finite: self.like_cdm,
        })
    }

    /// The first thing in which two runs differ, apart from their parts and the place of the input.
    pub fn difference(&self, other: &Self) -> Option<String> {
        let rows = |h: &Self| {
            h.rows
                .iter()
                .map(|r| format!("{} {} {} {}", r.name, r.input, r.engine, r.model))
                .collect::<Vec<_>>()
                .join(", ")
        };
        let facts = |h: &Self| {
            [
                ("program", format!("{} format {}", h.program, h.format)),
                ("rows", rows(h)),
                ("range and bins", format!("{} {}", h.metres.join(" "), h.bins)),
                ("--like-cdm", h.like_cdm.to_string()),
                ("--resize", h.resized.to_string()),
                ("options", h.options.iter().map(|(k, v)| format!("{k} {v}")).collect::<Vec<_>>().join(", ")),
                ("number of images", h.images.to_string()),
                ("number of parts", h.part.parts().to_string()),
                ("missing files", h.left_out.join("; ")),
            ]
        };
        let pairs = facts(self).into_iter().zip(facts(other));
        pairs.into_iter().find(|(a, b)| a != b).map(|((what, a), (_, b))| format!("{what}: {a} and {b}"))
    }
}

/// Measurements of one job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Number of the job, from 0, in the order of the source.
    pub image: u64,
    /// Each prediction.
    pub of: Vec<Of>,
    /// Why images could not be compared.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failed: Vec<String>,
    /// How many were left out, by reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub omitted: BTreeMap<String, u64>,
}

/// One prediction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Of {
    /// Camera or sensor.
    pub group: String,
    /// Row.
    pub row: usize,
    /// Where the image comes from.
    pub place: Place,
    /// Its sums.
    pub measured: Measured,
}

/// The end of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct End {
    /// Jobs of all parts together.
    pub images: u64,
}

/// Reads a file of sums line by line.
pub struct Reader {
    path: PathBuf,
    lines: BufReader<File>,
    /// Bytes of the header and the complete, valid records so far.
    good: u64,
    /// Its header.
    pub header: Header,
    /// Its end, once it was read.
    pub end: Option<End>,
}

impl Reader {
    /// Opens a file.
    ///
    /// # Errors
    /// When it is not a file of sums.
    pub fn open(path: &Path) -> Result<Self> {
        let file =
            depthrig_bus::files::open(path).with_context(|| format!("{}: cannot be read", path.display()))?;
        let mut lines = BufReader::new(file);
        let mut first = String::new();
        let wrong = || {
            format!("{}: not a file of sums that this program writes (depthrig eval --sums)", path.display())
        };
        lines.read_line(&mut first).with_context(wrong)?;
        let header: Header = serde_json::from_str(&first).with_context(wrong)?;
        if header.format != FORMAT {
            bail!("{}: format {}, and this program reads {FORMAT}", path.display(), header.format);
        }
        Ok(Self { path: path.to_owned(), good: first.len() as u64, lines, header, end: None })
    }

    /// The next record; `None` at the end, or where an incomplete file ends.
    ///
    /// # Errors
    /// When a complete line is damaged.
    pub fn next(&mut self) -> Result<Option<Record>> {
        if self.end.is_some() {
            return Ok(None);
        }
        let damaged = || {
            format!(
                "{}: damaged after byte {}; remove it and run its part again",
                self.path.display(),
                self.good
            )
        };
        let mut line = String::new();
        self.lines.read_line(&mut line).with_context(damaged)?;
        if !line.ends_with('\n') {
            return Ok(None);
        }
        // Only the last line is an end.
        if let Ok(end) = serde_json::from_str(&line) {
            self.end = Some(end);
            return Ok(None);
        }
        let record = serde_json::from_str(&line).with_context(damaged)?;
        self.good += line.len() as u64;
        Ok(Some(record))
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// A file of sums that is being written.
pub struct Writer {
    out: BufWriter<File>,
    part: PathBuf,
    path: PathBuf,
}

impl Writer {
    /// Begins `path`, or goes on where a killed run of the same arguments stopped: `known` gets the records that it left.
    ///
    /// # Errors
    /// When the file is of other arguments, or another process writes it.
    pub fn create(path: &Path, header: &Header, mut known: impl FnMut(Record) -> Result<()>) -> Result<Self> {
        let mut name = path.as_os_str().to_owned();
        name.push(".part");
        let part = PathBuf::from(name);
        let cannot = || format!("{}: cannot be written", part.display());
        let opened = open_part(&part);
        if opened.as_ref().is_err_and(|e| e.kind() == ErrorKind::WouldBlock) {
            bail!("{}: another process writes it; give each its own --shard and --sums", part.display())
        }
        let file = opened.with_context(cannot)?;
        let mut good = 0;
        let mut bytes = BufReader::new(&file);
        let mut first = String::new();
        // A line that was cut short is written anew.
        if bytes.read_line(&mut first).is_ok() && first.ends_with('\n') {
            drop(bytes);
            let mut reader = Reader::open(&part)?;
            same_run(&reader.header, header, &part)?;
            while let Ok(Some(record)) = reader.next() {
                known(record)?;
            }
            good = reader.good;
        }
        file.set_len(good).with_context(cannot)?;
        let mut out = BufWriter::new(file);
        out.seek(SeekFrom::Start(good)).with_context(cannot)?;
        let mut writer = Self { out, part, path: path.to_owned() };
        if good == 0 {
            writer.line(header)?;
        }
        Ok(writer)
    }

    /// Adds a record.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn add(&mut self, record: &Record) -> Result<()> {
        self.line(record)
    }

    /// Ends the file and gives it its name.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn finish(mut self, images: u64) -> Result<()> {
        self.line(&End { images })?;
        let cannot = || format!("{}: cannot be written", self.path.display());
        self.out.get_ref().sync_all().with_context(cannot)?;
        std::fs::rename(&self.part, &self.path).with_context(cannot)?;
        sync_folder_of(&self.path).with_context(cannot)
    }

    /// Removes what was written.
    pub fn discard(self) {
        drop(std::fs::remove_file(&self.part)); // what remains is written anew
    }

    fn line(&mut self, value: &impl Serialize) -> Result<()> {
        let cannot = || format!("{}: cannot be written", self.part.display());
        serde_json::to_writer(&mut self.out, value).with_context(cannot)?;
        self.out.write_all(b"\n").and_then(|()| self.out.flush()).with_context(cannot)
    }
}

/// Refuses a file of another run.
///
/// # Errors
/// Says what differs.
pub fn same_run(found: &Header, wanted: &Header, path: &Path) -> Result<()> {
    let part = |h: &Header| format!("part {} of {}", h.part, h.title);
    let other = if part(found) == part(wanted) {
        found.difference(wanted)
    } else {
        Some(format!("{} and {}", part(found), part(wanted)))
    };
    if let Some(other) = other {
        let text =
            format!("{}: it is of a run with other arguments ({other}); name another file", path.display());
        return Err(crate::exit::UsageError(text).into());
    }
    Ok(())
}
