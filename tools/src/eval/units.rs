//! Looks at the first images for a wrong depth unit, as `depthrig.lab` does.

use super::Loaded;
use core::fmt;
use std::collections::BTreeMap;

/// Images of each group that are looked at.
const LOOKED_AT: usize = 5;
/// The median of raw depth against the truth lies within a factor of this.
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

/// Depth seen so far, by group.
#[derive(Default)]
pub struct Units(BTreeMap<String, Seen>);

#[derive(Default)]
struct Seen {
    images: usize,
    empty: usize,
    ratios: Vec<f64>,
    is_checked: bool,
}

impl Units {
    /// Looks at an image with raw depth.
    ///
    /// # Errors
    /// When raw depth is off by more than a factor of 2 in the median, or empty in every image looked at.
    pub fn look(&mut self, image: &Loaded) -> Result {
        let Some((_, raw)) = &image.raw else { return Ok(()) };
        if self.0.get(&image.group).is_some_and(|s| s.is_checked) {
            return Ok(());
        }
        let seen = self.0.entry(image.group.clone()).or_default();
        let raw = raw.metres();
        let pairs = raw.pixels.iter().zip(&image.truth.pixels);
        let both = pairs.filter(|(r, t)| **r > 0.0 && t.is_finite() && **t > 0.0);
        seen.images += 1;
        seen.empty += usize::from(raw.pixels.iter().all(|r| *r <= 0.0));
        seen.ratios.extend(median(both.map(|(r, t)| f64::from(*r) / f64::from(*t)).collect()));
        if seen.images < LOOKED_AT {
            return Ok(());
        }
        seen.check(&image.group)
    }

    /// Checks groups of fewer images.
    ///
    /// # Errors
    /// As [`Self::look`].
    pub fn finish(&mut self) -> Result {
        let unchecked = self.0.iter_mut().filter(|(_, s)| !s.is_checked);
        unchecked.into_iter().try_for_each(|(group, seen)| seen.check(group))
    }
}

impl Seen {
    fn check(&mut self, group: &str) -> Result {
        self.is_checked = true;
        let what = if group.is_empty() { "raw depth".to_owned() } else { format!("{group}: raw depth") };
        if self.empty == self.images {
            return Err(WrongUnit(format!("{what} is empty in all of {} images looked at", self.images)));
        }
        if let Some(ratio) = median(self.ratios.clone()).filter(|r| !(1.0 / FACTOR..=FACTOR).contains(r)) {
            let advice = match ratio {
                r if (r - 10.0).abs() < 1.0 => "; a tenth of its unit would fit (--unit)",
                r if (r - 0.1).abs() < 0.01 => "; ten times its unit would fit (--unit)",
                r if (r - 1000.0).abs() < 100.0 => "; a thousandth of its unit would fit (--unit)",
                r if (r - 0.001).abs() < 0.0001 => "; a thousand times its unit would fit (--unit)",
                _ => "",
            };
            let text = format!(
                "{what} is {} times the truth in the median: one has a wrong unit{advice}",
                digits(ratio)
            );
            return Err(WrongUnit(text));
        }
        Ok(())
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
        let mut seen = Seen { images, empty, ratios: ratios.to_vec(), is_checked: false };
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
