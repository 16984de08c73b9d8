//! Whether weights are those of a camera depth model: every name, every shape, and every number.

use super::{Dtype, Weights};
use crate::{Encoder, Error, ErrorKind, Result};
use core::fmt::Write as _;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// How many of each kind a message lists.
const LISTED: usize = 8;

/// A tensor that should be there.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Missing {
    /// Its name.
    pub name: String,
    /// The shape that it should have.
    pub shape: Vec<usize>,
}

/// Something that is not of the network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Extra {
    /// Its name.
    pub name: String,
    /// Description, such as `a tensor of F32, shape [2, 3]`.
    pub what: String,
}

/// A tensor of another shape or of a type that a network cannot use.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Misshaped {
    /// Its name.
    pub name: String,
    /// Shape and type that were found.
    pub found: String,
    /// The shape that it should have.
    pub shape: Vec<usize>,
}

/// A tensor with NaN or infinite numbers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct NotFinite {
    /// Its name.
    pub name: String,
    /// How many are NaN.
    pub nan: u64,
    /// How many are infinite.
    pub infinite: u64,
}

/// Result of checking weights, with every finding.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Report {
    /// The network that they are compared with: the one asked for, else the nearest.
    pub encoder: Encoder,
    /// Tensors that are there as they should be.
    pub good: usize,
    /// Tensors that should be there and are not.
    pub missing: Vec<Missing>,
    /// Tensors that the network does not have.
    pub extra: Vec<Extra>,
    /// Tensors of another shape or type.
    pub misshaped: Vec<Misshaped>,
    /// Tensors with NaN or infinity; empty when numbers were not looked at.
    pub not_finite: Vec<NotFinite>,
}

impl Report {
    /// Whether nothing is wrong.
    pub const fn is_good(&self) -> bool {
        self.is_good_but_for_extra() && self.extra.is_empty()
    }

    /// Whether nothing is wrong but that there is more than the network needs.
    pub const fn is_good_but_for_extra(&self) -> bool {
        self.missing.is_empty() && self.misshaped.is_empty() && self.not_finite.is_empty()
    }

    /// In words, the first few of each kind.
    pub fn summary(&self) -> String {
        let mut text = String::new();
        let shape = |shape: &[usize]| format!("{shape:?}");
        list(&mut text, "missing", self.missing.iter().map(|m| format!("{} {}", m.name, shape(&m.shape))));
        let misshaped = |m: &Misshaped| format!("{} is {}, must be {}", m.name, m.found, shape(&m.shape));
        list(&mut text, "of another shape or type", self.misshaped.iter().map(misshaped));
        list(&mut text, "not of the network", self.extra.iter().map(|e| format!("{} ({})", e.name, e.what)));
        let numbers = |n: &NotFinite| format!("{}: {} NaN, {} infinite", n.name, n.nan, n.infinite);
        list(&mut text, "with NaN or infinite numbers", self.not_finite.iter().map(numbers));
        text
    }

    /// The error that says all this about `weights`.
    pub fn error(&self, weights: &Weights) -> Error {
        let path = weights.path().display();
        let mut message = format!(
            "{path}: not the weights of a camera depth model of encoder {}: {}",
            self.encoder,
            self.summary()
        );
        if self.is_good_but_for_extra() {
            message.push_str(
                ". The official code ignores what it does not know; `depthrig cdm import FILE --drop-extra` installs the \
                 model without it",
            );
        }
        Error::new(ErrorKind::BadModel, message)
    }
}

fn list(text: &mut String, what: &str, items: impl ExactSizeIterator<Item = String>) {
    let count = items.len();
    if count == 0 {
        return;
    }
    if !text.is_empty() {
        text.push_str("; ");
    }
    let _ = write!(text, "{count} {what} ("); // into a string: cannot fail
    let items: Vec<_> = items.take(LISTED).map(|i| i.chars().take(160).collect::<String>()).collect();
    text.push_str(&items.join(", "));
    if count > LISTED {
        let _ = write!(text, ", and {} more", count - LISTED);
    }
    text.push(')');
}

/// The encoder of `weights`, every name, shape and number of which is as it must be.
///
/// # Errors
/// [`ErrorKind::BadModel`] with a list of what is missing, too much, of another shape or not finite.
pub fn verify(weights: &Weights) -> Result<Encoder> {
    good(weights, &examine(weights, None)?)
}

/// As [`verify`], without looking at the numbers: for weights that were verified when they were installed.
///
/// # Errors
/// As [`verify`].
pub fn verify_names(weights: &Weights) -> Result<Encoder> {
    good(weights, &examine_names(weights, None)?)
}

fn good(weights: &Weights, report: &Report) -> Result<Encoder> {
    if report.is_good() { Ok(report.encoder) } else { Err(report.error(weights)) }
}

/// Compares `weights` with the network of `encoder`, or with the one that they are nearest to. Reads all of them, with
/// all cores.
///
/// # Errors
/// [`ErrorKind::BadModel`] when nothing of them is of any camera depth model, or when all of it is of another encoder.
pub fn examine(weights: &Weights, encoder: Option<Encoder>) -> Result<Report> {
    let mut report = examine_names(weights, encoder)?;
    let entries: Vec<_> = weights.entries().iter().collect();
    let found = entries.par_iter().map(|(name, entry)| -> Result<Option<NotFinite>> {
        let (nan, infinite) = match entry.dtype {
            // As the network will have them: what does not fit into 32 bits is infinite there.
            Dtype::F64 => {
                let numbers = weights.to_f32(name)?;
                let nan = numbers.iter().filter(|n| n.is_nan()).count() as u64;
                (nan, numbers.iter().filter(|n| n.is_infinite()).count() as u64)
            }
            stored => not_finite(&weights.read(name)?, stored),
        };
        Ok((nan + infinite > 0).then(|| NotFinite { name: (*name).clone(), nan, infinite }))
    });
    let found: Result<Vec<_>> = found.collect();
    report.not_finite = found?.into_iter().flatten().collect();
    Ok(report)
}

fn examine_names(weights: &Weights, encoder: Option<Encoder>) -> Result<Report> {
    let nearest = Encoder::ALL.into_iter().map(|e| compare(weights, e)).max_by_key(|report| report.good);
    let nearest = nearest.filter(|report| report.good > 0);
    match (encoder, nearest) {
        (Some(encoder), Some(near)) if near.encoder != encoder && near.missing.is_empty() => {
            let path = weights.path().display();
            let has = near.encoder;
            let message =
                format!("{path}: has the weights of the encoder {has}, and {encoder} was asked for");
            Err(Error::new(ErrorKind::BadModel, message))
        }
        (Some(encoder), Some(_)) => Ok(compare(weights, encoder)),
        (None, Some(near)) => Ok(near),
        (_, None) => Err(of_another_network(weights)),
    }
}

fn of_another_network(weights: &Weights) -> Error {
    let names: Vec<_> =
        weights.entries().keys().take(LISTED).map(|n| n.chars().take(80).collect::<String>()).collect();
    let message = format!(
        "{}: the weights of another network: none of its {} tensors is one of a camera depth model (it has {}, …)",
        weights.path().display(),
        weights.entries().len(),
        names.join(", ")
    );
    Error::new(ErrorKind::BadModel, message)
}

/// Names and shapes against those of one network.
fn compare(weights: &Weights, encoder: Encoder) -> Report {
    let mut report = Report {
        encoder,
        good: 0,
        missing: Vec::new(),
        extra: Vec::new(),
        misshaped: Vec::new(),
        not_finite: Vec::new(),
    };
    let expected: BTreeMap<_, _> =
        encoder.architecture().tensors().into_iter().map(|t| (t.name, t.shape)).collect();
    for (name, shape) in &expected {
        let name = name.clone();
        let shape = shape.clone();
        let found = match (weights.entries().get(&name), weights.others().get(&name)) {
            (Some(entry), _) if entry.shape == shape => {
                report.good += 1;
                continue;
            }
            (Some(entry), _) => format!("{:?}", entry.shape),
            (None, Some(what)) => what.clone(),
            (None, None) => {
                report.missing.push(Missing { name, shape });
                continue;
            }
        };
        report.misshaped.push(Misshaped { name, found, shape });
    }
    let tensors = weights.entries().iter();
    let tensors = tensors.map(|(n, e)| (n, format!("a tensor of {}, shape {:?}", e.dtype.name(), e.shape)));
    let others = weights.others().iter().map(|(n, what)| (n, what.clone()));
    let extra = tensors.chain(others).filter(|(name, _)| !expected.contains_key(*name));
    report.extra = extra.map(|(name, what)| Extra { name: name.clone(), what }).collect();
    report
}

/// How many numbers are NaN, and how many infinite.
fn not_finite(bytes: &[u8], dtype: Dtype) -> (u64, u64) {
    /// Exponent all ones: infinity when the rest is 0, else NaN.
    fn count(bits: impl Iterator<Item = u32>, exponent: u32, rest: u32) -> (u64, u64) {
        bits.fold((0, 0), |(nan, infinite), bits| {
            let special = u64::from(bits & exponent == exponent);
            let zero = u64::from(bits & rest == 0);
            (nan + (special & !zero & 1), infinite + (special & zero))
        })
    }
    let wide = bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let narrow = bytes.chunks_exact(2).map(|b| u32::from(u16::from_le_bytes([b[0], b[1]])));
    match dtype {
        Dtype::F64 => (0, 0),
        Dtype::F32 => count(wide, 0x7f80_0000, 0x007f_ffff),
        Dtype::F16 => count(narrow, 0x7c00, 0x03ff),
        Dtype::Bf16 => count(narrow, 0x7f80, 0x007f),
    }
}

#[cfg(test)]
mod tests;
