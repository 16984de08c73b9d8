//! The numbers of the engine, and the presets that choose them.

use crate::{Error, ErrorKind, Result};
use core::fmt;
use core::str::FromStr;

/// A trade-off between speed and quality. Recordings that stand in for a vendor's mode of the same name call them
/// `mimic_performance` and so on: they are not the vendor's closed algorithm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Preset {
    /// Matched at half the resolution.
    Performance,
    /// Matched at full resolution.
    Quality,
    /// Matched at both: what full resolution leaves open is taken from half.
    Ultra,
}

impl Preset {
    /// All of them, the fastest first.
    pub const ALL: [Self; 3] = [Self::Performance, Self::Quality, Self::Ultra];

    /// Its name: `performance`, `quality` or `ultra`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Performance => "performance",
            Self::Quality => "quality",
            Self::Ultra => "ultra",
        }
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Preset {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|p| p.name() == text).ok_or_else(|| {
            Error::new(
                ErrorKind::BadInput,
                format!("unknown stereo preset \"{text}\"; write performance, quality or ultra"),
            )
        })
    }
}

/// At which resolutions images are matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Resolution {
    /// Their own.
    Full,
    /// Half of it: an eighth of the work. Disparities are doubled, and lie on planes between those of neighbours.
    Half,
    /// Their own, and half of it where that gives nothing.
    Both,
}

impl fmt::Display for Resolution {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Full => "full",
            Self::Half => "half",
            Self::Both => "both",
        })
    }
}

/// Largest number of disparities: a winner is kept in a byte.
pub const MAX_DISPARITIES: usize = 256;

/// All that a result depends on. Made by [`Parameters::preset`]; a caller may change any of them.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Parameters {
    /// The preset that they come from; what a recording calls them.
    pub preset: Preset,
    /// Disparities that are searched, in pixels of the full image: 0 to this number less one. 1 to 256; nearer things
    /// than `focal_px * baseline_m / max_disparity` get none.
    pub max_disparity: usize,
    /// At which resolutions the images are matched.
    pub resolution: Resolution,
    /// Penalty of a step of one disparity between neighbours along a path, in census bits.
    pub p1: u8,
    /// Penalty of a larger step where grey does not change along the path, in census bits; at most 63.
    pub p2: u8,
    /// Lower bound of `p2` where grey changes; at least `p1`.
    pub p2_least: u8,
    /// Change of grey from which on `p2` comes down, by 1 for each level of grey.
    pub p2_slack: u8,
    /// By how many percent the best cost must be below the best that is not its neighbour.
    pub uniqueness_percent: u8,
    /// Mean margin, in a window of 13x13, between the best cost and the best that is not its neighbour below which there is no
    /// texture and so no disparity; 0 keeps all.
    pub texture_margin: u8,
    /// The same at half the resolution, whose noise is half as large.
    pub half_texture_margin: u8,
    /// Largest difference between the left and the right view's disparity, in pixels.
    pub left_right_px: u8,
    /// Where the views disagree, a pixel that some pixel of the right view has as its match takes that disparity.
    pub rematch: bool,
    /// Regions of at most this many pixels that differ from what surrounds them are removed; 0 keeps all.
    pub speckle_px: u32,
    /// Step of disparity, in pixels, at which a region ends.
    pub speckle_step_px: f32,
    /// How many times a median of 3x3 over what is valid is taken.
    pub median_rounds: u8,
    /// Gaps of at most this many pixels in a row or a column are filled when both ends are of one surface; 0 fills none.
    pub gap_px: u32,
    /// By how many pixels of disparity the ends of such a gap may differ.
    pub gap_step_px: f32,
}

impl Parameters {
    /// The numbers of `preset` for `max_disparity` disparities.
    pub const fn preset(preset: Preset, max_disparity: usize) -> Self {
        Self {
            preset,
            max_disparity,
            resolution: match preset {
                Preset::Performance => Resolution::Half,
                Preset::Quality => Resolution::Full,
                Preset::Ultra => Resolution::Both,
            },
            p1: 9,
            p2: 50,
            p2_least: 15,
            p2_slack: 4,
            uniqueness_percent: 0,
            texture_margin: 15,
            half_texture_margin: 20,
            left_right_px: 2,
            rematch: true,
            speckle_px: 100,
            speckle_step_px: 1.0,
            median_rounds: 3,
            gap_px: 32,
            gap_step_px: 4.0,
        }
    }

    /// Every number as `key=value` words, for the metadata of the result.
    pub fn describe(&self) -> String {
        let Self { preset, max_disparity, resolution, p1, p2, p2_least, p2_slack, .. } = self;
        let Self { uniqueness_percent, left_right_px, speckle_px, speckle_step_px, .. } = self;
        let Self { texture_margin, half_texture_margin, rematch, median_rounds, gap_px, gap_step_px, .. } =
            self;
        format!(
            "preset={preset} max_disparity={max_disparity} resolution={resolution} p1={p1} p2={p2} \
             p2_least={p2_least} p2_slack={p2_slack} uniqueness_percent={uniqueness_percent} \
             texture_margin={texture_margin} half_texture_margin={half_texture_margin} \
             left_right_px={left_right_px} rematch={rematch} speckle_px={speckle_px} \
             speckle_step_px={speckle_step_px} median_rounds={median_rounds} gap_px={gap_px} gap_step_px={gap_step_px}"
        )
    }

    /// Refuses invalid numbers.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`], naming the parameter.
    pub(crate) fn check(&self) -> Result<()> {
        let wrong = |text: String| Err(Error::new(ErrorKind::BadInput, text));
        if self.max_disparity == 0 || self.max_disparity > MAX_DISPARITIES {
            return wrong(format!(
                "a search of {} disparities is not possible; choose 1 to {MAX_DISPARITIES}, and shrink the images when things are nearer",
                self.max_disparity
            ));
        }
        let p1 = self.p1;
        let least = self.p2_least;
        let p2 = self.p2;
        if p1 == 0 || p1 > least || least > p2 || p2 > 63 {
            return wrong(format!(
                "penalties of p1 {p1}, p2_least {least} and p2 {p2} do not go together: 0 < p1 <= p2_least <= p2 <= 63"
            ));
        }
        for (what, step) in [("speckle_step_px", self.speckle_step_px), ("gap_step_px", self.gap_step_px)] {
            if !(step >= 0.0 && step.is_finite()) {
                return wrong(format!("invalid {what} = {step}; it must be finite and at least 0"));
            }
        }
        Ok(())
    }
}
