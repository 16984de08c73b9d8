//! Random numbers in a row.

use super::super::noise::Rolls;

/// The random numbers of one thing, one after the other.
#[derive(Debug)]
pub(crate) struct Draw {
    rolls: Rolls,
    at: u64,
}

impl Draw {
    /// Those of `purpose` of sample `number` of a run.
    pub(crate) const fn new(seed: u64, number: u64, purpose: u32) -> Self {
        Self { rolls: Rolls::new(seed, number as u32, (number >> 32) as u32, purpose), at: 0 }
    }

    /// Evenly in 0..1.
    pub(crate) fn unit(&mut self) -> f32 {
        self.at += 1;
        self.rolls.unit(self.at)
    }

    /// Evenly between two numbers.
    pub(crate) fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Between two positive numbers, evenly in their logarithm.
    pub(crate) fn scale(&mut self, low: f32, high: f32) -> f32 {
        low * (high / low).powf(self.unit())
    }

    /// A whole number below `n`, or 0.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        ((self.unit() * n as f32) as usize).min(n.saturating_sub(1))
    }

    /// True with this chance.
    pub(crate) fn chance(&mut self, chance: f32) -> bool {
        self.unit() < chance
    }

    /// One of several; the first of none is the default.
    pub(crate) fn pick<T: Copy + Default>(&mut self, of: &[T]) -> T {
        let i = self.below(of.len());
        of.get(i).copied().unwrap_or_default()
    }

    /// The place in a list of weights that a draw falls on.
    pub(crate) fn weighted(&mut self, weights: &[f32]) -> usize {
        let mut left = self.unit() * weights.iter().sum::<f32>();
        for (i, weight) in weights.iter().enumerate() {
            left -= weight;
            if left < 0.0 {
                return i;
            }
        }
        weights.len().saturating_sub(1)
    }
}
