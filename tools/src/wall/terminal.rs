//! The means by which a terminal shows images, and the questions that find out.

use super::layout::{Area, Cell, Grid, Place};
use super::{blocks, kitty, sixel};
use crate::screen::{self, Screen};
use anyhow::Result;
use core::fmt::Write as _;
use core::time::Duration;
use image::RgbImage;

/// Time that a terminal gets to answer; one at the other end of the world takes a third of it.
const ANSWER: Duration = Duration::from_secs(1);
/// Pixels of all images together: more would make each rarer.
const PIXELS: f64 = 500_000.0;
/// Asks for a character's size (XTWINOPS 16) and for the attributes of the terminal (DA1), which every terminal answers.
const SIZE_AND_ATTRIBUTES: &str = "\x1b[16t\x1b[c";
/// The attribute of terminals with sixel graphics.
const SIXEL: &str = "4";

/// How images are shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Means {
    /// The graphics protocol of kitty: PNG.
    Kitty,
    /// Sixel graphics of up to 256 colours.
    Sixel,
    /// Half blocks in 24-bit colours, two pixels a character.
    Blocks,
}

impl Means {
    /// The name as an option has it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Kitty => "kitty",
            Self::Sixel => "sixel",
            Self::Blocks => "blocks",
        }
    }
}

/// That of a terminal that does not say.
const USUAL_CELL: Cell = Cell { width: 10, height: 20 };

/// Largest image of a tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// Columns of pixels.
    pub width: u32,
    /// Rows of pixels.
    pub height: u32,
}

/// A terminal that shows images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Terminal {
    /// How.
    pub means: Means,
    /// Its characters' size.
    pub cell: Cell,
}

/// Finds out how the terminal shows images; `means` decides where it is given. A multiplexer passes no images on, so below
/// one it is half blocks.
///
/// # Errors
/// When the terminal is gone.
pub fn find(screen: &Screen, means: Option<Means>) -> Result<Terminal> {
    let is_multiplexed = std::env::var_os("TMUX").is_some_and(|v| !v.is_empty())
        || std::env::var("TERM").is_ok_and(|t| t.starts_with("tmux") || t.starts_with("screen"));
    let answer = if is_multiplexed {
        Vec::new()
    } else {
        screen
            .ask(&format!("{}{SIZE_AND_ATTRIBUTES}", kitty::QUESTION), ANSWER, |a| attributes(a).is_some())?
    };
    let cell = screen::cell()
        .map(|(width, height)| Cell { width, height })
        .or_else(|| cell_of(&answer))
        .unwrap_or(USUAL_CELL);
    Ok(Terminal { means: means.unwrap_or_else(|| means_of(&answer)), cell })
}

fn means_of(answer: &[u8]) -> Means {
    if kitty::is_answer(answer) {
        Means::Kitty
    } else if attributes(answer).is_some_and(|all| all.split(';').skip(1).any(|a| a == SIXEL)) {
        Means::Sixel
    } else {
        Means::Blocks
    }
}

/// The attributes in an answer, `62;4;22` of `ESC [ ? 62 ; 4 ; 22 c`.
fn attributes(answer: &[u8]) -> Option<String> {
    sequence(answer, "\x1b[?", 'c')
}

/// The size in an answer, `ESC [ 6 ; HEIGHT ; WIDTH t`.
fn cell_of(answer: &[u8]) -> Option<Cell> {
    let numbers = sequence(answer, "\x1b[6;", 't')?;
    let (height, width) = numbers.split_once(';')?;
    let side = |text: &str| text.parse().ok().filter(|n| (1..=200).contains(n));
    Some(Cell { width: side(width)?, height: side(height)? })
}

/// The text between `start` and `end` of the first such sequence of numbers.
fn sequence(answer: &[u8], start: &str, end: char) -> Option<String> {
    let text = String::from_utf8_lossy(answer);
    text.split(start).skip(1).find_map(|rest| {
        let (inside, _) = rest.split_once(end)?;
        inside.chars().all(|c| c.is_ascii_digit() || c == ';').then(|| inside.to_owned())
    })
}

impl Terminal {
    /// Largest image of a tile.
    pub fn pixels(self, grid: Grid) -> Size {
        let (columns, rows) = (grid.columns as u32, grid.rows as u32);
        match self.means {
            Means::Blocks => Size { width: columns, height: 2 * rows },
            Means::Kitty | Means::Sixel => {
                let room = (columns * self.cell.width as u32, rows * self.cell.height as u32);
                let pixels = f64::from(room.0) * f64::from(room.1) * grid.shown as f64;
                let scale = (PIXELS / pixels).sqrt().min(1.0);
                let side = |n: u32| (f64::from(n) * scale) as u32;
                Size { width: side(room.0), height: side(room.1) }
            }
        }
    }

    /// Draws an image at a place; one with a number replaces the one before with that number.
    pub fn image(self, image: &RgbImage, place: Place, number: usize) -> String {
        let at = format!("\x1b[{};{}H", place.row, place.column);
        match self.means {
            Means::Kitty => at + &kitty::image(image, number),
            Means::Sixel => at + &sixel::image(image),
            Means::Blocks => blocks::image(image, place),
        }
    }

    /// Erases the images that are not made of characters.
    pub const fn erase_all(self) -> &'static str {
        match self.means {
            Means::Kitty => kitty::ERASE,
            Means::Sixel | Means::Blocks => "",
        }
    }

    /// Erases an area.
    pub fn erase(self, area: Area) -> String {
        let mut out = self.erase_all().to_owned();
        for row in area.row..area.row + area.rows {
            // Writing to a string cannot fail.
            let _ = write!(out, "\x1b[{row};1H\x1b[2K");
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_that_the_terminal_answers() {
        let kitty = b"\x1b_Gi=31;OK\x1b\\\x1b[6;18;9t\x1b[?62;c";
        let foot = b"\x1b[6;18;9t\x1b[?62;4;22c";
        // 64 is not 4, nor is the level, which comes first.
        let others: [&[u8]; 4] =
            [b"", b"\x1b[?62;64;22c", b"\x1b[?4;6c", b"\x1b_Gi=31;ENOTSUPPORTED:no\x1b\\\x1b[?1;2c"];
        assert_eq!(means_of(kitty), Means::Kitty);
        assert_eq!(means_of(foot), Means::Sixel);
        assert!(others.iter().all(|a| means_of(a) == Means::Blocks));
        assert_eq!(cell_of(foot), Some(Cell { width: 9, height: 18 }));
        assert_eq!(cell_of(b"\x1b[6;0;9t"), None);
        assert_eq!(cell_of(b"\x1b[6;18"), None);
    }

    #[test]
    fn an_answer_is_complete_with_its_attributes() {
        assert_eq!(attributes(b"\x1b_Gi=31;OK\x1b\\\x1b[6;18;9t\x1b[?62;4"), None);
        assert_eq!(attributes(b"\x1b[?62;4c").as_deref(), Some("62;4"));
    }
}
