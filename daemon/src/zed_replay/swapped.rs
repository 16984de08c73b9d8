//! Whether the left eye's pictures are the right eye's: found out before any depth is made of them.

use super::input::{Input, Next};
use super::modes::geometry;
use super::pictures::Maker;
use super::{MAX_PROBLEMS, ZedReplayOptions};
use depthrig_calib::stereo::{DisparityMap, Preset, StereoPair};
use depthrig_drivers::stereo::StereoMode;
use depthrig_recorder::{Error, ErrorKind, Result};

/// Exchanged eyes match in at least this share of the pixels, and the others in less than half of that.
const MATCHED: f64 = 0.2;

/// Refuses an input whose first pair matches when its eyes are exchanged, and does not as it is. A thing in front of both
/// eyes is further to the left in the right one; exchanged, nearly nothing survives the left-right check.
pub(super) fn check(input: &mut Input, maker: &Maker, options: &ZedReplayOptions) -> Result<()> {
    let mut raw = None;
    for _ in 0..MAX_PROBLEMS {
        match input.next()? {
            Next::Pair(_, Some(pair)) => raw = Some(pair),
            Next::Pair(_, None) | Next::Damaged(..) => continue,
            Next::End => {}
        }
        break;
    }
    input.rewind()?;
    let Some(raw) = raw else { return Ok(()) };
    let views = maker.rectify(&raw)?;
    let pair = views.pair();
    let failed = |e: depthrig_calib::Error| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e);
    let mode = StereoMode::preset(Preset::Performance, options.range_m.0, options.jobs.max(1));
    let mut matcher = (mode.make)(&geometry(&maker.rectifier)).map_err(failed)?;
    let mut map = DisparityMap::default();
    matcher.run(&StereoPair::new(pair.left, pair.right), &mut map).map_err(failed)?;
    let as_it_is = map.fill();
    matcher.run(&StereoPair::new(pair.right, pair.left), &mut map).map_err(failed)?;
    let exchanged = map.fill();
    if exchanged < MATCHED || as_it_is > exchanged / 2.0 {
        return Ok(());
    }
    Err(Error::new(
        ErrorKind::BadInput,
        format!(
            "left and right are swapped: the first pair matches in {:.0} % of its pixels as it is, and in {:.0} % with its \
             eyes exchanged; exchange the pictures, or the cameras' names in the rig that recorded them",
            as_it_is * 100.0,
            exchanged * 100.0
        ),
    ))
}
