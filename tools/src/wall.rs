//! Small images of all streams of the running rig, in the terminal.
//!
//! Of each stream the newest frame is shown, a few times a second. What is sent is limited to [`BYTES_PER_S`], because
//! the terminal may be at the other end of a slow line: the more an image takes, the rarer it comes.

mod blocks;
mod kitty;
mod layout;
mod sixel;
mod terminal;
mod tile;

pub use layout::Area;
pub use terminal::{Means, find};

use crate::printable::{self, BOLD, RESET, YELLOW};
use core::fmt::Write as _;
use core::time::Duration;
use depthrig_bus::{Bus, HostTime, StreamId};
use depthrig_daemon::status::RigStatus;
use image::RgbImage;
use layout::Grid;
use terminal::Terminal;
use tile::Tile;

/// Most images of a stream a second.
const RATE_HZ: f64 = 4.0;
/// Most bytes a second that images take, on average.
const BYTES_PER_S: f64 = 1e6;
/// A stream without a new frame for this long is marked.
const STALE: Duration = Duration::from_secs(1);

/// Images of all streams.
pub struct Wall {
    bus: Bus,
    terminal: Terminal,
    tiles: Vec<Tile>,
    /// Where they were drawn; another place means that everything is drawn anew.
    drawn: Option<Grid>,
    next: HostTime,
}

impl Wall {
    /// A wall for a rig's streams, which [`Self::follow`] names.
    pub fn new(bus: Bus, terminal: Terminal) -> Self {
        Self { bus, terminal, tiles: Vec::new(), drawn: None, next: HostTime::now() }
    }

    /// Takes over the streams of a rig. One that cannot be read yet is tried again with the next call.
    pub fn follow(&mut self, rig: &RigStatus) {
        let mut known = core::mem::take(&mut self.tiles);
        for stream in rig.cameras.iter().flat_map(|c| &c.streams).filter(|s| s.samples_hz.is_none()) {
            let Ok(id) = stream.id.parse::<StreamId>() else { continue };
            let mut tile = match known.iter().position(|t| t.id == id) {
                Some(i) => known.swap_remove(i),
                None => Tile::new(id),
            };
            tile.subscribe(&self.bus);
            self.tiles.push(tile);
        }
    }

    /// Draws everything anew next time: the screen was cleared.
    pub fn forget(&mut self) {
        self.drawn = None;
        self.next = HostTime::now();
    }

    /// Takes the images off the screen, as far as clearing it does not.
    pub const fn gone(&self) -> &'static str {
        self.terminal.erase_all()
    }

    /// Time until the next round.
    pub fn due_in(&self) -> Duration {
        self.next.from_now()
    }

    /// Draws the tiles that have new frames: what to write to the terminal. Empty before the next round is due.
    pub fn round(&mut self, area: Area) -> String {
        if !self.due_in().is_zero() || self.tiles.is_empty() {
            return String::new();
        }
        let grid = Grid::new(self.tiles.len(), area, self.terminal.cell);
        let mut out = String::new();
        let is_moved = self.drawn != Some(grid);
        if is_moved {
            out.push_str(&self.terminal.erase(area));
            self.drawn = Some(grid);
        }
        let size = self.terminal.pixels(grid);
        for tile in self.tiles.iter_mut().take(grid.shown) {
            tile.look(size, is_moved);
        }
        let range = tile::range(&self.tiles);
        for (i, tile) in self.tiles.iter_mut().enumerate().take(grid.shown) {
            let place = grid.place(i);
            let _ = write!(out, "\x1b[{};{}H{}", place.row, place.column, label(tile, grid.columns));
            if let Some(image) = tile.image(range, size) {
                out.push_str(&self.terminal.image(&image, place.below(), i));
            }
        }
        let pause = (out.len() as f64 / BYTES_PER_S).max(1.0 / RATE_HZ);
        self.next = HostTime::now().plus(Duration::from_secs_f64(pause));
        out
    }

    /// A note for below the images: how they are shown, and how many streams are not.
    pub fn note(&self) -> String {
        let shown = self.drawn.map_or(0, |grid| grid.shown);
        let hidden = self.tiles.len().saturating_sub(shown);
        let more = if hidden > 0 && shown > 0 {
            format!("; no room for {hidden} of {} streams", self.tiles.len())
        } else {
            String::new()
        };
        format!("images as {}{more}", self.terminal.means.name())
    }
}

/// The line above an image: the stream's name, and what is wrong with it.
fn label(tile: &Tile, columns: usize) -> String {
    let text = printable::line(&tile.label(STALE));
    let text: String = text.chars().chain(core::iter::repeat(' ')).take(columns).collect();
    format!("{}{text}{RESET}", if tile.is_stale(STALE) { YELLOW } else { BOLD })
}

/// Scales an image down so that it fits; one that does is left as it is.
fn fitted(image: RgbImage, width: u32, height: u32) -> RgbImage {
    if image.width() <= width && image.height() <= height {
        return image;
    }
    let scale =
        (f64::from(width) / f64::from(image.width())).min(f64::from(height) / f64::from(image.height()));
    let side = |n: u32| ((f64::from(n) * scale) as u32).max(1);
    image::imageops::thumbnail(&image, side(image.width()), side(image.height()))
}
