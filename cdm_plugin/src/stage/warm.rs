//! Runs a refiner once at every shape that a rig will give it, before anybody waits for a result.

use crate::{Color, ColorFormat, ErrorKind, Job, Output, RawDepth, Refiner, Result, StepTimes};

/// Grey, and a wall at one metre.
const GREY: u8 = 128;
const WALL_MM: u16 = 1000;

/// Refines plain images of each of `sizes` (width and height, one for each camera), in batches as large as cameras of that size and
/// [`Refiner::best_batch`] allow, and in every smaller one: engines compile, and make room for, each shape when it comes first.
/// Does nothing for a refiner that gains nothing ([`Refiner::warms_up`]). A size that the refiner refuses is left for the camera's own
/// images to report.
///
/// # Errors
/// Those of the refiner.
pub fn warm_up(refiner: &mut dyn Refiner, sizes: &[(usize, usize)]) -> Result<()> {
    if !refiner.warms_up() {
        return Ok(());
    }
    let mut sorted = sizes.to_vec();
    sorted.sort_unstable();
    for same in sorted.chunk_by(|a, b| a == b) {
        let Some((width, height)) = same.first().copied() else { continue };
        let color = vec![GREY; 3 * width * height];
        let depth = vec![WALL_MM; width * height];
        // The largest first: memory that it needs is enough for the others.
        for batch in (1..=same.len().min(refiner.best_batch())).rev() {
            let mut outputs = vec![vec![0u16; width * height]; batch];
            let mut jobs: Vec<_> = outputs
                .iter_mut()
                .map(|pixels| Job {
                    color: Color {
                        pixels: &color,
                        format: ColorFormat::Rgb8,
                        width,
                        height,
                        stride: 3 * width,
                    },
                    depth: RawDepth { pixels: &depth, unit_m: 0.001 },
                    out: Output::Units { pixels, unit_m: 0.001 },
                    steps: StepTimes::default(),
                })
                .collect();
            match refiner.refine(&mut jobs) {
                Err(e) if matches!(e.kind(), ErrorKind::BadInput | ErrorKind::SizeMismatch) => {}
                done => done?,
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Description, Error};

    struct Seen {
        description: Description,
        gains: bool,
        batches: Vec<(usize, usize, usize)>,
        fails: Option<ErrorKind>,
    }

    impl Seen {
        fn new(gains: bool, fails: Option<ErrorKind>) -> Self {
            let description = Description { engine: "seen".into(), model: String::new() };
            Self { description, gains, batches: Vec::new(), fails }
        }
    }

    impl Refiner for Seen {
        fn describe(&self) -> &Description {
            &self.description
        }

        fn best_batch(&self) -> usize {
            2
        }

        fn warms_up(&self) -> bool {
            self.gains
        }

        fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
            for job in jobs.iter() {
                job.color.check()?;
                job.depth.check(&job.color)?;
                job.out.check(job.color.width, job.color.height)?;
                assert!(job.depth.pixels.iter().all(|d| *d > 0), "without depth a network would not run");
            }
            self.batches.push((jobs[0].color.width, jobs[0].color.height, jobs.len()));
            self.fails.map_or(Ok(()), |kind| Err(Error::new(kind, "as told")))
        }
    }

    #[test]
    fn each_shape_of_the_rig_runs_once() {
        let sizes = [(64, 48), (32, 24), (64, 48), (64, 48)];
        let mut seen = Seen::new(true, None);
        warm_up(&mut seen, &sizes).unwrap();
        assert_eq!(seen.batches, [(32, 24, 1), (64, 48, 2), (64, 48, 1)]);
        let mut seen = Seen::new(false, None);
        warm_up(&mut seen, &sizes).unwrap();
        assert_eq!(seen.batches, []);
        let mut seen = Seen::new(true, Some(ErrorKind::BadInput));
        warm_up(&mut seen, &sizes).unwrap();
        assert_eq!(seen.batches.len(), 3, "images that are refused are not an error of the engine");
        let error = warm_up(&mut Seen::new(true, Some(ErrorKind::OutOfMemory)), &sizes).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::OutOfMemory);
    }
}
