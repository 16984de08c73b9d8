//! Tensors as numbers of the shape that the network needs.

use super::Weights;
use crate::{Error, ErrorKind, Result};

impl Weights {
    /// The numbers of the tensor `name`, as 32-bit floats, row-major.
    ///
    /// # Errors
    /// [`ErrorKind::BadModel`] when there is no such tensor, or its shape is not `shape`.
    pub fn floats(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let refused = |what: String| {
            let message = format!(
                "{}: {what}; it is damaged or of another network: import the checkpoint again",
                self.path().display()
            );
            Error::new(ErrorKind::BadModel, message)
        };
        let entry = self.entries().get(name).ok_or_else(|| refused(format!("there is no tensor {name}")))?;
        if entry.shape != shape {
            return Err(refused(format!(
                "the tensor {name} has the shape {:?} and not {shape:?}",
                entry.shape
            )));
        }
        self.to_f32(name)
    }
}
