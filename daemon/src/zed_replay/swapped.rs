//! Whether the left eye's pictures are the right eye's: found out before any depth is made of them.

use super::input::{Input, Next};
use super::pictures::Maker;
use depthrig_calib::stereo::{Order, OrderCheck};
use depthrig_recorder::{Error, ErrorKind, Result};

/// Pairs at the beginning that are looked at.
const LOOKED_AT: usize = 5;

/// Refuses an input whose first pairs look exchanged: at least one, and none that looks as it should.
pub(super) fn check(input: &mut Input, maker: &Maker) -> Result<()> {
    let failed = |e: depthrig_calib::Error| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e);
    let (width, height) = maker.rectifier.size();
    let mut order = OrderCheck::new(width as usize, height as usize).map_err(failed)?;
    let mut swapped = false;
    for _ in 0..LOOKED_AT {
        match input.next()? {
            Next::Pair(_, Some(raw)) => match order.check(&maker.rectify(&raw)?.pair()).map_err(failed)? {
                Order::AsNamed => {
                    swapped = false;
                    break;
                }
                Order::Swapped => swapped = true,
                Order::Unclear => {}
            },
            Next::Pair(_, None) | Next::Damaged(..) => {}
            Next::End => break,
        }
    }
    input.rewind()?;
    if !swapped {
        return Ok(());
    }
    Err(Error::new(
        ErrorKind::BadInput,
        "left and right are swapped: what is near lies further right in the right eye's pictures; exchange the pictures, or \
         the cameras' names in the rig that recorded them",
    ))
}
