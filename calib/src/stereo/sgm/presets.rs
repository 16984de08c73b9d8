//! Several presets out of one matching: `ultra` is `quality` with what `performance` adds, so all three cost what it does.

use super::{Outs, SgmMatcher};
use crate::stereo::{Description, DisparityMap, Matcher, Parameters, Resolution, StereoPair};
use crate::{Error, ErrorKind, Result};

/// Matches pairs once and gives what several [`SgmMatcher`]s would, which differ in their resolution alone. The result is
/// the same bit for bit.
#[derive(Debug)]
pub struct SgmPresets {
    matcher: SgmMatcher,
    wanted: Vec<Parameters>,
}

impl SgmPresets {
    /// Prepares for pairs of `width` x `height` pixels, as [`SgmMatcher::new`].
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for parameters that differ in more than [`Parameters::preset`] and
    /// [`Parameters::resolution`], for none, for two of one resolution, and as [`SgmMatcher::new`].
    pub fn new(width: usize, height: usize, wanted: &[Parameters], threads: usize) -> Result<Self> {
        let bad = |what: &str| Err(Error::new(ErrorKind::BadInput, what));
        let Some(first) = wanted.first() else {
            return bad("no preset is asked for; name one, such as quality");
        };
        let alike =
            |p: &Parameters| Parameters { preset: first.preset, resolution: first.resolution, ..p.clone() };
        if wanted.iter().any(|p| alike(p) != *first) {
            return bad("presets with different numbers cannot be matched at once; use a matcher for each");
        }
        if wanted.iter().enumerate().any(|(i, p)| wanted[..i].iter().any(|q| q.resolution == p.resolution)) {
            return bad("two presets of one resolution are the same; ask for one");
        }
        let resolution = if wanted.len() > 1 { Resolution::Both } else { first.resolution };
        let matcher = SgmMatcher::new(width, height, &Parameters { resolution, ..first.clone() }, threads)?;
        Ok(Self { matcher, wanted: wanted.to_vec() })
    }

    /// Describes each preset, in the requested order; the memory is that of all.
    pub fn describe(&self) -> Vec<Description> {
        let all = self.matcher.describe();
        let of = |p: &Parameters| Description {
            name: p.preset.name().to_owned(),
            parameters: p.describe(),
            ..all.clone()
        };
        self.wanted.iter().map(of).collect()
    }

    /// Fills one map for each preset, in their order, from a pair of the agreed size.
    ///
    /// # Errors
    /// As [`Matcher::run`]; [`ErrorKind::SizeMismatch`] when there are not as many maps as presets.
    pub fn run(&mut self, pair: &StereoPair<'_>, out: &mut [DisparityMap]) -> Result<()> {
        if out.len() != self.wanted.len() {
            let what = format!("{} maps for {} presets; give one for each", out.len(), self.wanted.len());
            return Err(Error::new(ErrorKind::SizeMismatch, what));
        }
        let mut outs = Outs::default();
        for (p, map) in self.wanted.iter().zip(out) {
            *outs.of(p.resolution) = Some(map);
        }
        self.matcher.run_into(pair, outs)
    }
}
