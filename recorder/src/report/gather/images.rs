//! Checks some of the images: depth of evenly chosen sets, and first, middle and last set for the report.

use super::super::pixels::{Image, Small, depth_range};
use super::super::{OnProgress, ReportOptions, Sampled, SetImages, Shown};
use super::Pass;
use crate::dataset::{DatasetSet, PixelMode, SetReader};
use crate::{ErrorKind, Result};
use core::ops::ControlFlow;
use std::collections::BTreeMap;

/// Streams whose images are shown, at most.
const SHOWN_MAX: usize = 32;

/// Images that were checked.
pub(super) struct SampledImages {
    /// Numbers of the sets whose depth is checked, increasing.
    fill_sets: Vec<usize>,
    /// Numbers of the sets that are shown, increasing, with their titles.
    shown: Vec<(usize, &'static str)>,
    pub(super) fill: Vec<Vec<(i64, f64)>>,
    pub(super) sampled: Sampled,
    pub(super) images: Vec<SetImages>,
}

impl SampledImages {
    pub(super) fn new(reader: &SetReader, streams: usize, options: &ReportOptions) -> Self {
        let sets = reader.times().len();
        let wanted = options.fill_sets.min(sets);
        let evenly = |k: usize| if wanted > 1 { k * (sets - 1) / (wanted - 1) } else { 0 };
        let last = sets.saturating_sub(1);
        let mut shown = vec![(0, "first"), (last / 2, "middle"), (last, "last")];
        shown.dedup_by_key(|(number, _)| *number);
        shown.retain(|_| sets > 0);
        Self {
            fill_sets: (0..wanted).map(evenly).collect(),
            shown,
            fill: vec![Vec::new(); streams],
            sampled: Sampled::default(),
            images: Vec::new(),
        }
    }

    pub(super) fn look(
        &mut self,
        reader: &mut SetReader,
        pass: &mut Pass,
        progress: OnProgress<'_>,
    ) -> Result<ControlFlow<()>> {
        let mut numbers: Vec<_> =
            self.fill_sets.iter().copied().chain(self.shown.iter().map(|s| s.0)).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let mut small: Vec<BTreeMap<usize, Small>> = Vec::new();
        for (done, number) in numbers.iter().enumerate() {
            let fraction = 500 + 500 * done / numbers.len();
            if progress(fraction as u64).is_break() {
                return Ok(ControlFlow::Break(()));
            }
            match reader.read(*number, PixelMode::Stored) {
                Ok(set) => self.set(*number, &set, pass, &mut small),
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => pass.problem(e.to_string()),
            }
        }
        self.show(&small, pass);
        Ok(ControlFlow::Continue(()))
    }

    fn set(
        &mut self,
        number: usize,
        set: &DatasetSet,
        pass: &mut Pass,
        small: &mut Vec<BTreeMap<usize, Small>>,
    ) {
        let title = self.shown.iter().find(|(n, _)| *n == number).map(|(_, title)| *title);
        let measured = self.fill_sets.binary_search(&number).is_ok();
        let at_ns = set.utc_ns - pass.t0_ns;
        let mut shown = BTreeMap::new();
        for f in &set.frames {
            let is_depth = f.header.pixel_format().is_some_and(depthrig_bus::PixelFormat::is_depth);
            let show = title.is_some() && f.stream < SHOWN_MAX;
            if !(show || measured && is_depth) {
                continue;
            }
            match Image::of(f) {
                Ok(image) => {
                    self.sampled.images += 1;
                    if let (true, Some(fill)) = (measured, image.fill()) {
                        self.fill[f.stream].push((at_ns, fill));
                    }
                    if show {
                        shown.insert(f.stream, image.small());
                    }
                }
                Err(e) => pass.problem(e.to_string()),
            }
        }
        self.sampled.sets += usize::from(measured);
        if let Some(title) = title {
            self.images.push(SetImages { title, number, at_ns, images: BTreeMap::new() });
            small.push(shown);
        }
    }

    /// Turns the small copies into embedded images; a stream's depth has the same colours in each set.
    fn show(&mut self, small: &[BTreeMap<usize, Small>], pass: &mut Pass) {
        for stream in 0..self.fill.len() {
            let range_m = depth_range(small.iter().filter_map(|set| set.get(&stream)));
            for (set, page) in small.iter().zip(&mut self.images) {
                let Some(image) = set.get(&stream) else { continue };
                let (width, height) = image.size();
                match image.data_uri(range_m) {
                    Ok(data_uri) => {
                        page.images.insert(stream, Shown { data_uri, width, height, range_m });
                    }
                    Err(e) => pass.problem(e.to_string()),
                }
            }
        }
    }
}
