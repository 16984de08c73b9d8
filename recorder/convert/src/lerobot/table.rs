//! Parquet as LeRobot wants it: flat columns, images as a struct of bytes and a name, lists in metadata only.

use crate::{OutFile, Output};
use bytes::Bytes;
use depthrig_recorder::fs::ReadFile;
use depthrig_recorder::{Error, ErrorKind, Result};
use parquet::basic::{Compression, ConvertedType, LogicalType, Repetition, Type as Physical, ZstdLevel};
use parquet::column::writer::ColumnCloseResult;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, FloatType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::{KeyValue, ParquetMetaData, ParquetMetaDataReader};
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::file::reader::{ChunkReader, Length};
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::{ColumnPath, Type, TypePtr};
use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;

/// Type of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Bool,
    Int64,
    Float32,
    Text,
    /// Struct of `bytes` and `path`, as `datasets.Image` stores it; `packed` when zstd gains something.
    Image {
        packed: bool,
    },
    /// List of text, not null.
    TextList,
    /// List of so many floats, not null.
    Floats {
        length: usize,
    },
    /// Lists within lists of doubles, this deep; null without values.
    Doubles {
        depth: u8,
    },
    /// List of integers; null without a list.
    Int64List,
}

/// The values of a column for some rows.
#[derive(Debug, Clone)]
pub(super) enum Values {
    Bool(Vec<bool>),
    Int64(Vec<i64>),
    Float32(Vec<f32>),
    Text(Vec<ByteArray>),
    Image {
        bytes: Vec<ByteArray>,
        paths: Vec<ByteArray>,
    },
    TextList(Vec<Vec<ByteArray>>),
    Floats(Vec<Vec<f32>>),
    /// Per row: the values along the outermost list; the lists within hold one each.
    Doubles(Vec<Option<Vec<f64>>>),
    Int64List(Vec<Option<Vec<i64>>>),
}

/// A table of a name and a kind per column.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    pub(super) columns: Vec<(String, Kind)>,
    /// Written into the file's footer.
    pub(super) footer: Vec<(&'static str, String)>,
}

fn leaf(name: &str, physical: Physical, text: bool) -> parquet::errors::Result<TypePtr> {
    let builder = Type::primitive_type_builder(name, physical).with_repetition(Repetition::OPTIONAL);
    let builder = if text {
        builder.with_converted_type(ConvertedType::UTF8).with_logical_type(Some(LogicalType::String))
    } else {
        builder
    };
    builder.build().map(Arc::new)
}

/// `name` as a list of `element`, in the three levels that Parquet prescribes.
fn list(name: &str, element: TypePtr) -> parquet::errors::Result<TypePtr> {
    let repeated = Type::group_type_builder("list")
        .with_repetition(Repetition::REPEATED)
        .with_fields(vec![element])
        .build()?;
    let list = Type::group_type_builder(name)
        .with_repetition(Repetition::OPTIONAL)
        .with_converted_type(ConvertedType::LIST)
        .with_logical_type(Some(LogicalType::List))
        .with_fields(vec![Arc::new(repeated)]);
    list.build().map(Arc::new)
}

impl Layout {
    fn schema(&self) -> parquet::errors::Result<TypePtr> {
        let mut fields = Vec::with_capacity(self.columns.len());
        for (name, kind) in &self.columns {
            fields.push(match *kind {
                Kind::Bool => leaf(name, Physical::BOOLEAN, false)?,
                Kind::Int64 => leaf(name, Physical::INT64, false)?,
                Kind::Float32 => leaf(name, Physical::FLOAT, false)?,
                Kind::Text => leaf(name, Physical::BYTE_ARRAY, true)?,
                Kind::Image { .. } => {
                    let bytes = leaf("bytes", Physical::BYTE_ARRAY, false)?;
                    let path = leaf("path", Physical::BYTE_ARRAY, true)?;
                    let group = Type::group_type_builder(name).with_repetition(Repetition::OPTIONAL);
                    Arc::new(group.with_fields(vec![bytes, path]).build()?)
                }
                Kind::TextList => list(name, leaf("element", Physical::BYTE_ARRAY, true)?)?,
                Kind::Floats { .. } => list(name, leaf("element", Physical::FLOAT, false)?)?,
                Kind::Int64List => list(name, leaf("element", Physical::INT64, false)?)?,
                Kind::Doubles { depth } => {
                    let mut element = leaf("element", Physical::DOUBLE, false)?;
                    for _ in 1..depth {
                        element = list("element", element)?;
                    }
                    list(name, element)?
                }
            });
        }
        Type::group_type_builder("schema").with_fields(fields).build().map(Arc::new)
    }

    /// Dictionaries and statistics are of no use here: images are all different and are not searched for.
    fn properties(&self) -> parquet::errors::Result<Arc<WriterProperties>> {
        let zstd = Compression::ZSTD(ZstdLevel::try_new(1)?);
        let footer = self.footer.iter().map(|(key, value)| KeyValue::new((*key).to_owned(), value.clone()));
        let mut builder = WriterProperties::builder()
            .set_dictionary_enabled(false)
            .set_compression(zstd)
            .set_key_value_metadata(Some(footer.collect()));
        for (name, kind) in &self.columns {
            if let Kind::Image { packed } = kind {
                let bytes = ColumnPath::new(vec![name.clone(), "bytes".to_owned()]);
                builder = builder.set_column_statistics_enabled(bytes.clone(), EnabledStatistics::None);
                if !packed {
                    builder = builder.set_column_compression(bytes, Compression::UNCOMPRESSED);
                }
            }
        }
        Ok(Arc::new(builder.build()))
    }
}

/// The file, until it is taken out of the Parquet writer to be finished.
struct Sink<'a>(Option<OutFile<'a>>);

impl io::Write for Sink<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.as_mut().map_or_else(|| Err(io::ErrorKind::BrokenPipe.into()), |file| file.write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Writes a table, a row group at a time.
pub(super) struct TableWriter<'a> {
    writer: SerializedFileWriter<Sink<'a>>,
    name: String,
}

impl<'a> TableWriter<'a> {
    /// Begins a table; `name` is for messages.
    pub(super) fn new(file: OutFile<'a>, name: &str, layout: &Layout) -> Result<Self> {
        let new = || SerializedFileWriter::new(Sink(Some(file)), layout.schema()?, layout.properties()?);
        let writer = new().map_err(|e| failed("write", name, e))?;
        Ok(Self { writer, name: name.to_owned() })
    }

    /// Appends rows: one entry per column of the layout, all of the same length.
    pub(super) fn rows(&mut self, columns: &[Values]) -> Result<()> {
        write_group(&mut self.writer, columns).map_err(|e| failed("write", &self.name, e))
    }

    /// Appends the rows of another table of the same layout without unpacking them, and says how many.
    pub(super) fn append(&mut self, table: &Table) -> Result<u64> {
        let metadata = table.metadata()?;
        for group in metadata.row_groups() {
            let mut append = || {
                let mut out = self.writer.next_row_group()?;
                for column in group.columns() {
                    let close = ColumnCloseResult {
                        bytes_written: column.compressed_size() as u64,
                        rows_written: group.num_rows() as u64,
                        metadata: column.clone(),
                        bloom_filter: None,
                        column_index: None,
                        offset_index: None,
                    };
                    out.append_column(table, close)?;
                }
                out.close().map(drop)
            };
            append().map_err(|e| failed("write", &self.name, e))?;
        }
        Ok(metadata.file_metadata().num_rows() as u64)
    }

    /// Writes the footer, makes the file durable, gives it its name and says how long it is.
    pub(super) fn close(self) -> Result<u64> {
        let Self { mut writer, name } = self;
        // Not `into_inner`: that reports a failed write as text, and a full disk must be known as one.
        writer.finish().map_err(|e| failed("write", &name, e))?;
        let gone = || Error::new(ErrorKind::Io, format!("cannot write {name}: it is closed already"));
        writer.inner_mut().0.take().ok_or_else(gone)?.finish()
    }
}

/// A finished table.
pub(super) struct Table {
    file: Arc<dyn ReadFile>,
    name: String,
    pub(super) bytes: u64,
}

impl Table {
    /// The table `name` of an export; `None` when it is not there.
    pub(super) fn open(out: &Output<'_>, name: &str) -> Result<Option<Self>> {
        let Some(file) = out.open_file(name)? else { return Ok(None) };
        let bytes = file.size().map_err(|e| Error::reading("read", &out.dir().join(name), e))?;
        Ok(Some(Self { file: file.into(), name: name.to_owned(), bytes }))
    }

    fn metadata(&self) -> Result<ParquetMetaData> {
        ParquetMetaDataReader::new().parse_and_finish(self).map_err(|e| failed("read", &self.name, e))
    }

    /// Its rows.
    pub(super) fn rows(&self) -> Result<u64> {
        Ok(self.metadata()?.file_metadata().num_rows() as u64)
    }
}

/// A table from one place on.
pub(super) struct From {
    file: Arc<dyn ReadFile>,
    at: u64,
    end: u64,
}

impl Read for From {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        let n = buf.len().min(usize::try_from(self.end.saturating_sub(self.at)).unwrap_or(usize::MAX));
        self.file.read_exact_at(&mut buf[..n], self.at)?;
        self.at += n as u64;
        Ok(n)
    }
}

impl Length for Table {
    fn len(&self) -> u64 {
        self.bytes
    }
}

impl ChunkReader for Table {
    type T = From;

    fn get_read(&self, start: u64) -> parquet::errors::Result<From> {
        Ok(From { file: Arc::clone(&self.file), at: start, end: self.bytes })
    }

    fn get_bytes(&self, start: u64, length: usize) -> parquet::errors::Result<Bytes> {
        let mut bytes = vec![0; length];
        self.file.read_exact_at(&mut bytes, start)?;
        Ok(bytes.into())
    }
}

fn write_group(
    writer: &mut SerializedFileWriter<Sink<'_>>,
    columns: &[Values],
) -> parquet::errors::Result<()> {
    let mut group = writer.next_row_group()?;
    for column in columns {
        match column {
            Values::Bool(v) => flat::<BoolType>(&mut group, v, 1)?,
            Values::Int64(v) => flat::<Int64Type>(&mut group, v, 1)?,
            Values::Float32(v) => flat::<FloatType>(&mut group, v, 1)?,
            Values::Text(v) => flat::<ByteArrayType>(&mut group, v, 1)?,
            Values::Image { bytes, paths } => {
                images(&mut group, bytes)?;
                flat::<ByteArrayType>(&mut group, paths, 2)?;
            }
            Values::TextList(rows) => {
                let rows = rows.iter().map(|r| Some(r.as_slice()));
                lists::<ByteArrayType>(&mut group, rows)?;
            }
            Values::Floats(rows) => {
                lists::<FloatType>(&mut group, rows.iter().map(|r| Some(r.as_slice())))?;
            }
            Values::Int64List(rows) => {
                lists::<Int64Type>(&mut group, rows.iter().map(Option::as_deref))?;
            }
            Values::Doubles(rows) => {
                lists::<DoubleType>(&mut group, rows.iter().map(Option::as_deref))?;
            }
        }
    }
    group.close().map(drop)
}

type Group<'a, 'f> = SerializedRowGroupWriter<'a, Sink<'f>>;

/// Writes the next leaf column: values with their definition and repetition levels.
fn write_leaf<T: DataType>(
    group: &mut Group<'_, '_>,
    write: impl FnOnce(&mut parquet::column::writer::ColumnWriterImpl<'_, T>, i16) -> parquet::errors::Result<()>,
) -> parquet::errors::Result<()> {
    let missing = || ParquetError::General("more columns than the layout has".to_owned());
    let mut column = group.next_column()?.ok_or_else(missing)?;
    let typed = column.typed::<T>();
    let deepest = typed.get_descriptor().max_def_level();
    write(typed, deepest)?;
    column.close()
}

/// A column without nulls below `level` optional groups.
fn flat<T: DataType>(group: &mut Group<'_, '_>, values: &[T::T], level: i16) -> parquet::errors::Result<()> {
    write_leaf::<T>(group, |column, deepest| {
        debug_assert_eq!(deepest, level);
        column.write_batch(values, Some(&vec![deepest; values.len()]), None).map(drop)
    })
}

/// Images one by one: a batch is one page at the least, and pages are held in memory.
fn images(group: &mut Group<'_, '_>, values: &[ByteArray]) -> parquet::errors::Result<()> {
    write_leaf::<ByteArrayType>(group, |column, deepest| {
        values
            .iter()
            .try_for_each(|v| column.write_batch(core::slice::from_ref(v), Some(&[deepest]), None).map(drop))
    })
}

/// Lists whose inner lists, if any, hold one value each: a value begins a row or continues its outermost list.
fn lists<'v, T: DataType>(
    group: &mut Group<'_, '_>,
    rows: impl Iterator<Item = Option<&'v [T::T]>>,
) -> parquet::errors::Result<()>
where
    T::T: 'v,
{
    let mut values = Vec::new();
    let mut definition = Vec::new();
    let mut repetition = Vec::new();
    write_leaf::<T>(group, |column, deepest| {
        for row in rows {
            let row = row.unwrap_or_default();
            if row.is_empty() {
                definition.push(0);
                repetition.push(0);
            }
            for (i, value) in row.iter().enumerate() {
                values.push(value.clone());
                definition.push(deepest);
                repetition.push(i16::from(i > 0));
            }
        }
        column.write_batch(&values, Some(&definition), Some(&repetition)).map(drop)
    })
}

/// Text as Parquet holds it.
pub(super) fn text(s: impl Into<String>) -> ByteArray {
    ByteArray::from(s.into().into_bytes())
}

/// An error of the table writer or reader, with the disk's own error if that is what it was.
fn failed(what: &str, name: &str, e: ParquetError) -> Error {
    match e {
        ParquetError::External(source) => match source.downcast::<io::Error>() {
            Ok(io) => Error::io(what, Path::new(name), *io),
            Err(other) => Error::new(ErrorKind::Io, format!("cannot {what} {name}: {other}")),
        },
        other => Error::new(ErrorKind::Corrupt, format!("cannot {what} {name}: {other}")).with_source(other),
    }
}
