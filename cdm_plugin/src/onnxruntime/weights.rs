//! The weights of a model where ONNX Runtime can read them: in their own file when they lie there as 32-bit floats.
// Hands addresses of the mapped file to the library.
#![allow(unsafe_code)]

use crate::onnx::WeightSlice;
use crate::weights::{Dtype, Entry};
use crate::{Error, ErrorKind, Result, Weights, durable};
use core::ffi::c_void;
use core::ops::Range;
use core::sync::atomic::{AtomicU32, Ordering};
use ort::AsPointer;
use ort::memory::MemoryInfo;
use ort::session::builder::SessionBuilder;
use ort::value::{Shape, TensorRefMut};
use std::collections::BTreeMap;
use std::ffi::CString;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Weights that outlive the session that reads them.
#[derive(Debug)]
pub struct BoundWeights {
    /// Keeps the file open, and mapped where it is read in place.
    weights: Arc<Weights>,
    /// Tensors that do not lie in the file as they are needed: of 16-bit floats, or at an odd address.
    converted: BTreeMap<String, Vec<f32>>,
    /// Slices that the graph needs.
    slices: Vec<WeightSlice>,
}

impl BoundWeights {
    /// Finds all `slices` in `weights`; converts other number types.
    ///
    /// # Errors
    /// [`ErrorKind::BadModel`] for a tensor that is not there or has another size.
    pub fn new(weights: &Arc<Weights>, slices: &[WeightSlice]) -> Result<Self> {
        let mut converted = BTreeMap::new();
        for slice in slices {
            let name = &slice.tensor;
            let wrong = |what: &str| {
                let message = format!("{}: the tensor {name} {what}", weights.path().display());
                Error::new(ErrorKind::BadModel, message)
            };
            let entry = weights.entries().get(name).ok_or_else(|| wrong("is missing"))?;
            let rows = entry.shape.first().copied().unwrap_or(0);
            let needed = slice.shape.iter().product::<usize>();
            let there = entry.shape.iter().skip(1).product::<usize>() * slice.rows.len();
            if slice.rows.end > rows || needed != there {
                return Err(wrong(&format!("has the shape {:?}", entry.shape)));
            }
            if !in_place(entry) && !converted.contains_key(name) {
                converted.insert(name.clone(), weights.to_f32(name)?);
            }
        }
        Ok(Self { weights: Arc::clone(weights), converted, slices: slices.to_vec() })
    }

    /// The numbers of one slice, little-endian 32-bit floats at an even address.
    fn bytes(&self, slice: &WeightSlice) -> Result<Option<*const u8>> {
        let rows = rows_of(slice);
        if let Some(numbers) = self.converted.get(&slice.tensor) {
            let numbers: &[u8] = bytemuck::cast_slice::<f32, u8>(numbers);
            return Ok(numbers.get(rows).map(<[u8]>::as_ptr));
        }
        let Some(entry) = self.weights.entries().get(&slice.tensor) else { return Ok(None) };
        let tensor = self.weights.mapped()?.get(entry.bytes.clone());
        Ok(tensor.and_then(|bytes| bytes.get(rows)).map(<[u8]>::as_ptr))
    }

    /// Locates each slice in a file: the weights' own, or, if that lacks the required form, a temporary one that exists
    /// until the session is open.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the file is gone, or cannot be made.
    pub fn in_file(&self) -> Result<WeightsFile> {
        let path = self.weights.path();
        // The engine takes names in UTF-8.
        if !self.converted.is_empty() || path.to_str().is_none() {
            return self.copied();
        }
        let path = path.canonicalize().map_err(|e| {
            Error::new(ErrorKind::Io, format!("{}: cannot be found again: {e}", path.display()))
                .with_source(e)
        })?;
        let entries = self.weights.entries();
        let place = |slice: &WeightSlice| {
            let from = entries.get(&slice.tensor).map_or(0, |e| e.bytes.start);
            let rows = rows_of(slice);
            from + rows.start..from + rows.end
        };
        let places = self.slices.iter().map(place).collect();
        Ok(WeightsFile { path, places, temporary: None })
    }

    fn copied(&self) -> Result<WeightsFile> {
        let temporary = TemporaryFolder::new()?;
        let path = temporary.0.join("weights");
        let mut places = Vec::with_capacity(self.slices.len());
        let mut at = 0;
        durable::create(&path, |out| {
            for slice in &self.slices {
                let numbers = match self.converted.get(&slice.tensor) {
                    Some(numbers) => bytemuck::cast_slice::<f32, u8>(numbers).to_vec(),
                    None => self.weights.read(&slice.tensor).map_err(std::io::Error::other)?,
                };
                let part = numbers.get(rows_of(slice)).ok_or(std::io::ErrorKind::InvalidData)?;
                out.write_all(part)?;
                places.push(at..at + part.len());
                at += part.len();
            }
            Ok(())
        })?;
        Ok(WeightsFile { path, places, temporary: Some(temporary) })
    }

    /// Puts the weights in their places in the session that `builder` will make, which must not outlive `self`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the file cannot be mapped; inside, those of the library.
    pub fn bind(&self, builder: &mut SessionBuilder) -> Result<ort::Result<()>> {
        let mut data = Vec::with_capacity(self.slices.len());
        for slice in &self.slices {
            data.push(self.bytes(slice)?);
        }
        Ok(self.bind_at(&data, builder))
    }

    fn bind_at(&self, data: &[Option<*const u8>], builder: &mut SessionBuilder) -> ort::Result<()> {
        let mut names = Vec::with_capacity(self.slices.len());
        let mut values = Vec::with_capacity(self.slices.len());
        for (slice, data) in self.slices.iter().zip(data) {
            let missing = || ort::Error::new(format!("no numbers for {}", slice.initializer));
            let data = data.ok_or_else(missing)?.cast::<c_void>().cast_mut();
            let shape = Shape::new(slice.shape.iter().map(|n| *n as i64));
            names.push(CString::new(slice.initializer.as_str()).map_err(|_| missing())?);
            // SAFETY: `data` is aligned for 32-bit floats (`in_place`: the mapping begins at a page) and as many of them
            // as `shape` says follow it (`new`, `bytes`); the mapping and the vectors live as long as `self`. The library does not write to
            // initializers.
            values.push(unsafe { TensorRefMut::<f32>::from_raw(MemoryInfo::default(), data, shape)? });
        }
        let name_pointers: Vec<_> = names.iter().map(|n| n.as_ptr()).collect();
        let value_pointers: Vec<_> = values.iter().map(|v| v.ptr()).collect();
        // SAFETY: both arrays have this length and their strings and values are alive; the library copies the names
        // and counts references to the values (`AddExternalInitializers`, onnxruntime_c_api.h).
        unsafe {
            ort::Error::result_from_status((ort::api().AddExternalInitializers)(
                builder.ptr_mut(),
                name_pointers.as_ptr(),
                value_pointers.as_ptr(),
                names.len(),
            ))
        }
    }
}

/// Whether an engine can read the tensor where it lies in its file.
fn in_place(entry: &Entry) -> bool {
    let aligned = entry.bytes.start.is_multiple_of(align_of::<f32>());
    entry.dtype == Dtype::F32 && entry.strides.is_none() && aligned
}

/// The bytes of a slice within those of its tensor, as 32-bit floats.
fn rows_of(slice: &WeightSlice) -> Range<usize> {
    let row = 4 * slice.shape.iter().product::<usize>() / slice.rows.len().max(1);
    slice.rows.start * row..slice.rows.end * row
}

/// Weights in a file that an engine opens by its name.
#[derive(Debug)]
pub struct WeightsFile {
    path: PathBuf,
    places: Vec<Range<usize>>,
    /// Removed with this; who has mapped the file keeps it.
    temporary: Option<TemporaryFolder>,
}

impl WeightsFile {
    /// The name of the file in its folder.
    pub fn name(&self) -> &str {
        self.path.file_name().and_then(|n| n.to_str()).unwrap_or_default()
    }

    /// The folder.
    pub fn folder(&self) -> &str {
        self.path.parent().and_then(Path::to_str).unwrap_or_default()
    }

    /// Byte ranges of the slices, in the given order.
    pub fn places(&self) -> &[Range<usize>] {
        &self.places
    }

    /// Returns whether the file is temporary.
    pub const fn is_temporary(&self) -> bool {
        self.temporary.is_some()
    }
}

/// A private folder, removed when dropped.
#[derive(Debug)]
struct TemporaryFolder(PathBuf);

impl TemporaryFolder {
    fn new() -> Result<Self> {
        static CREATED: AtomicU32 = AtomicU32::new(0);
        let name = format!("depthrig-{}-{}", std::process::id(), CREATED.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(name);
        // Fails if the name exists.
        let created = std::fs::DirBuilder::new().mode(0o700).create(&path);
        created.map_err(|e| durable::cannot_write(&path, e))?;
        Ok(Self(path))
    }
}

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        drop(std::fs::remove_dir_all(&self.0)); // leftovers stay in the temporary folder
    }
}
