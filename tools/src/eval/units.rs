//! Looks at the first images for a wrong depth unit, as `depthrig.lab` does.

use super::Loaded;
use super::read::Metres;
use core::fmt;
use std::collections::BTreeMap;

/// Images of each group that are looked at.
const LOOKED_AT: usize = 5;
/// The median of depth against the truth lies within a factor of this.
const FACTOR: f64 = 2.0;

/// Raw depth that cannot be meant: nothing that was measured of it is of use.
#[derive(Debug)]
pub struct WrongUnit(String);

impl fmt::Display for WrongUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for WrongUnit {}

type Result = core::result::Result<(), WrongUnit>;

/// Depth seen so far.
#[derive(Default)]
pub struct Units {
    /// Raw depth by group.
    raw: BTreeMap<String, Seen>,
    /// Predictions that were read, by row.
    predicted: BTreeMap<usize, Seen>,
}

#[derive(Default)]
struct Seen {
    images: usize,
    empty: usize,
    ratios: Vec<f64>,
}

impl Units {
    /// Looks at an image as it was read.
    ///
    /// # Errors
    /// When raw depth is off by more than a factor of 2 in the median, or empty in every image looked at.
    pub fn look(&mut self, image: &Loaded) -> Result {
        for (row, prediction) in &image.predictions {
            self.predicted.entry(*row).or_default().add(prediction, &image.truth);
        }
        let Some((_, raw)) = &image.raw else { return Ok(()) };
        let seen = self.raw.entry(image.group.clone()).or_default();
        if seen.images == LOOKED_AT {
            return Ok(());
        }
        seen.add(&raw.metres(), &image.truth);
        if seen.images == LOOKED_AT { seen.check(&image.group) } else { Ok(()) }
    }

    /// Checks groups of fewer images. Returns the predictions that are off as much, in words; `names` are those of the rows.
    /// They are warnings, because a model may be that bad.
    ///
    /// # Errors
    /// As [`Self::look`].
    pub fn finish(&self, names: &[String]) -> core::result::Result<Vec<String>, WrongUnit> {
        let mut few = self.raw.iter().filter(|(_, s)| s.images < LOOKED_AT);
        few.try_for_each(|(group, seen)| seen.check(group))?;
        let doubt = |(row, seen): (&usize, &Seen)| {
            let ratio = seen.off()?;
            Some(format!(
                "{} is {} times the truth in the median: one may have a wrong unit{}",
                names.get(*row)?,
                digits(ratio),
                advice(ratio)
            ))
        };
        Ok(self.predicted.iter().filter_map(doubt).collect())
    }
}

impl Seen {
    /// Looks at an image if it is one of the first.
    fn add(&mut self, depth: &Metres, truth: &Metres) {
        if self.images == LOOKED_AT {
            return;
        }
        let pairs = depth.pixels.iter().zip(&truth.pixels);
        let both = pairs.filter(|(d, t)| d.is_finite() && **d > 0.0 && t.is_finite() && **t > 0.0);
        self.images += 1;
        self.empty += usize::from(depth.pixels.iter().all(|d| d.is_nan() || *d <= 0.0));
        self.ratios.extend(median(both.map(|(d, t)| f64::from(*d) / f64::from(*t)).collect()));
    }

    /// The median against the truth, if it is off by more than the factor.
    fn off(&self) -> Option<f64> {
        median(self.ratios.clone()).filter(|r| !(1.0 / FACTOR..=FACTOR).contains(r))
    }

    fn check(&self, group: &str) -> Result {
        let what = if group.is_empty() { "raw depth".to_owned() } else { format!("{group}: raw depth") };
        if self.empty == self.images {
            return Err(WrongUnit(format!("{what} is empty in all of {} images looked at", self.images)));
        }
        self.off().map_or(Ok(()), |ratio| {
            Err(WrongUnit(format!(
                "{what} is {} times the truth in the median: one has a wrong unit{}",
                digits(ratio),
                advice(ratio)
            )))
        })
    }
}

/// The unit that would fit, where the ratio is that of two usual ones.
fn advice(ratio: f64) -> &'static str {
    match ratio {
        r if (r - 10.0).abs() < 1.0 => "; a tenth of its unit would fit (--unit)",
        r if (r - 0.1).abs() < 0.01 => "; ten times its unit would fit (--unit)",
        r if (r - 1000.0).abs() < 100.0 => "; a thousandth of its unit would fit (--unit)",
        r if (r - 0.001).abs() < 0.0001 => "; a thousand times its unit would fit (--unit)",
        _ => "",
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    values.select_nth_unstable_by(middle, f64::total_cmp);
    Some(values[middle])
}

/// Three digits.
fn digits(x: f64) -> String {
    let places = (2.0 - x.log10().floor()).max(0.0) as usize;
    format!("{x:.places$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(ratios: &[f64], images: usize, empty: usize) -> String {
        let seen = Seen { images, empty, ratios: ratios.to_vec() };
        seen.check("d435").err().map(|e| e.to_string()).unwrap_or_default()
    }

    #[test]
    fn a_wrong_unit_is_named_with_one_that_would_fit() {
        assert_eq!(seen(&[0.5, 1.0, 2.0], 3, 0), "");
        assert_eq!(
            seen(&[1.0, 9.98, 10.02], 3, 0),
            "d435: raw depth is 9.98 times the truth in the median: one has a wrong unit; a tenth of its unit would fit (--unit)"
        );
        assert!(seen(&[0.0251], 1, 0).contains("0.0251 times"), "{}", seen(&[0.0251], 1, 0));
        assert_eq!(seen(&[], 4, 4), "d435: raw depth is empty in all of 4 images looked at");
        assert_eq!(seen(&[1.0], 4, 3), "");
    }
}
