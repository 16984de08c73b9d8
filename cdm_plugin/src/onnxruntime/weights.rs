//! The weights of a model where ONNX Runtime can read them: in the mapped file when they lie there as 32-bit floats.
// Hands addresses of the mapped file to the library.
#![allow(unsafe_code)]

use crate::onnx::WeightSlice;
use crate::weights::Dtype;
use crate::{Error, ErrorKind, Result, Weights};
use core::ffi::c_void;
use ort::AsPointer;
use ort::memory::MemoryInfo;
use ort::session::builder::SessionBuilder;
use ort::value::{Shape, TensorRefMut};
use std::collections::BTreeMap;
use std::ffi::CString;
use std::sync::Arc;

/// Weights that outlive the session that reads them.
#[derive(Debug)]
pub struct BoundWeights {
    /// Keeps the file mapped.
    weights: Arc<Weights>,
    /// Tensors that do not lie in the file as they are needed: of 16-bit floats, or at an odd address.
    converted: BTreeMap<String, Vec<f32>>,
    /// What the graph needs.
    slices: Vec<WeightSlice>,
}

impl BoundWeights {
    /// Finds every one of `slices` in `weights`; converts what is stored as something else.
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
            let bytes = weights.bytes(name).ok_or_else(|| wrong("lies beyond the end of the file"))?;
            let rows = entry.shape.first().copied().unwrap_or(0);
            let needed = slice.shape.iter().product::<usize>();
            let there = entry.shape.iter().skip(1).product::<usize>() * slice.rows.len();
            if slice.rows.end > rows || needed != there {
                return Err(wrong(&format!("has the shape {:?}", entry.shape)));
            }
            let aligned = bytes.as_ptr().addr().is_multiple_of(align_of::<f32>());
            let in_place = entry.dtype == Dtype::F32 && aligned;
            if !in_place && !converted.contains_key(name) {
                let numbers = weights.to_f32(name).ok_or_else(|| wrong("cannot be read"))?;
                converted.insert(name.clone(), numbers);
            }
        }
        Ok(Self { weights: Arc::clone(weights), converted, slices: slices.to_vec() })
    }

    /// The numbers of one slice, little-endian 32-bit floats at an even address.
    fn bytes(&self, slice: &WeightSlice) -> Option<*const u8> {
        let row = 4 * slice.shape.iter().product::<usize>() / slice.rows.len().max(1);
        let whole: (*const u8, usize) = if let Some(numbers) = self.converted.get(&slice.tensor) {
            (numbers.as_ptr().cast(), size_of_val(numbers.as_slice()))
        } else {
            let bytes = self.weights.bytes(&slice.tensor)?;
            (bytes.as_ptr(), bytes.len())
        };
        // `wrapping_add` because only what is read has to be within bounds; it is, see `new`.
        (slice.rows.end * row <= whole.1).then(|| whole.0.wrapping_add(slice.rows.start * row))
    }

    /// Puts the weights in their places in the session that `builder` will make, which must not outlive `self`.
    pub fn bind(&self, builder: &mut SessionBuilder) -> ort::Result<()> {
        let mut names = Vec::with_capacity(self.slices.len());
        let mut values = Vec::with_capacity(self.slices.len());
        for slice in &self.slices {
            let missing = || ort::Error::new(format!("no numbers for {}", slice.initializer));
            let data = self.bytes(slice).ok_or_else(missing)?.cast::<c_void>().cast_mut();
            let shape = Shape::new(slice.shape.iter().map(|n| *n as i64));
            names.push(CString::new(slice.initializer.as_str()).map_err(|_| missing())?);
            // SAFETY: `data` is aligned for 32-bit floats and as many of them as `shape` says follow it, both checked
            // in `new`; the mapping and the vectors live as long as `self`. The library does not write to
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
