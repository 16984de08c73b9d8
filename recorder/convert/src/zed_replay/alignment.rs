//! Checks left and right images against the calibration before any depth is computed: they must not be swapped, and a
//! thing must lie in one row in both.

use super::images::Maker;
use super::input::{Input, Next};
use depthrig_calib::stereo::{Order, OrderCheck, RowCheck, RowOffset};
use depthrig_recorder::{Error, ErrorKind, Result};

/// Pairs at the beginning whose order is looked at.
const ORDERED: usize = 5;
/// Of the pairs at the beginning each of this many is looked at for its rows: others than the one before, if anything moves.
const ROWS_EVERY: usize = 4;
/// Pairs that are read at most.
const READ: usize = ROWS_EVERY * (RowCheck::PAIRS - 1) + 1;

/// Refuses an input whose first pairs look exchanged: at least one, and none that looks as it should. Returns how far rows
/// are apart in them, where the images say it.
pub(super) fn check(input: &mut Input, maker: &Maker) -> Result<Option<RowOffset>> {
    let failed = |e: depthrig_calib::Error| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e);
    let (width, height) = maker.rectifier.size();
    let mut order = OrderCheck::new(width as usize, height as usize).map_err(failed)?;
    let mut rows = RowCheck::new(width as usize, height as usize);
    let mut swapped = false;
    let mut named = false;
    for n in 0..READ {
        let raw = match input.next()? {
            Next::Pair(_, Some(raw)) => raw,
            Next::Pair(_, None) | Next::Damaged(..) => continue,
            Next::End => break,
        };
        let asks_order = n < ORDERED && !named;
        let asks_rows = n.is_multiple_of(ROWS_EVERY);
        if !asks_order && !asks_rows {
            continue;
        }
        let views = maker.rectify(&raw)?;
        if asks_order {
            match order.check(&views.pair()).map_err(failed)? {
                Order::AsNamed => named = true,
                Order::Swapped => swapped = true,
                Order::Unclear => {}
            }
        }
        if asks_rows {
            rows.look(&views.pair()).map_err(failed)?;
        }
    }
    input.rewind()?;
    if named || !swapped {
        return Ok(rows.offset());
    }
    Err(Error::new(
        ErrorKind::BadInput,
        "left and right are swapped: what is near lies further right in the right images; exchange the images, or \
         the cameras' names in the rig that recorded them",
    ))
}
