//! Both images of a pair, halved until they are small.

use super::sgm::halve;
use super::{Gray, StereoPair};

/// Both images in some size.
#[derive(Debug)]
struct Level {
    size: (usize, usize),
    images: [Vec<u8>; 2],
}

impl Level {
    fn both(&self) -> [Gray<'_>; 2] {
        let (w, h) = self.size;
        [Gray::packed(&self.images[0], w, h), Gray::packed(&self.images[1], w, h)]
    }
}

/// Copies of a pair, each half as large as the one before; the pair itself is level 0.
#[derive(Debug)]
pub struct Pyramid {
    levels: Vec<Level>,
}

impl Pyramid {
    /// For pairs of a size, halved until they are no wider than `most` pixels.
    pub fn new((mut w, mut h): (usize, usize), most: usize) -> Self {
        let mut levels = Vec::new();
        while w > most {
            (w, h) = (w.div_ceil(2), h.div_ceil(2));
            levels.push(Level { size: (w, h), images: [vec![0; w * h], vec![0; w * h]] });
        }
        Self { levels }
    }

    /// How often a pair is halved.
    pub const fn halvings(&self) -> usize {
        self.levels.len()
    }

    /// Width and height of the smallest copies of pairs of this size.
    pub fn smallest(&self, width: usize, height: usize) -> (usize, usize) {
        self.levels.last().map_or((width, height), |l| l.size)
    }

    /// Halves a pair of the size that it was made for.
    pub fn fill(&mut self, pair: &StereoPair<'_>) {
        for i in 0..self.levels.len() {
            let (before, here) = self.levels.split_at_mut(i);
            let Some(level) = here.first_mut() else { break };
            let from = before.last().map_or([pair.left, pair.right], Level::both);
            for (from, to) in from.iter().zip(&mut level.images) {
                halve(from, to);
            }
        }
    }

    /// Both images after so many halvings; of the pair itself for 0.
    pub fn level<'a>(&'a self, pair: &StereoPair<'a>, halvings: usize) -> [Gray<'a>; 2] {
        let level = halvings.checked_sub(1).and_then(|i| self.levels.get(i));
        level.map_or([pair.left, pair.right], Level::both)
    }
}
