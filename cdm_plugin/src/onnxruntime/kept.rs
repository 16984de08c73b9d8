//! Values by size of images: rigs have few sizes, which take turns.

/// Sizes that are kept; the oldest goes. More than a rig has.
const SIZES: usize = 8;

/// Values by size, the one in use last at the end.
#[derive(Debug)]
pub(super) struct Kept<K, T>(Vec<(K, T)>);

impl<K: PartialEq, T> Kept<K, T> {
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// Makes the value for `size` the last one; `false` without such a value. Allocates nothing.
    pub(super) fn turn_to(&mut self, size: &K) -> bool {
        let found = self.0.iter().position(|(known, _)| known == size);
        if let Some(at) = found {
            self.0[at..].rotate_left(1);
        }
        found.is_some()
    }

    /// Adds the value for a size that has none.
    pub(super) fn push(&mut self, size: K, value: T) {
        if self.0.len() == SIZES {
            self.0.remove(0);
        }
        self.0.push((size, value));
    }

    pub(super) fn last(&self) -> Option<&T> {
        self.0.last().map(|(_, value)| value)
    }

    pub(super) fn last_mut(&mut self) -> Option<(&K, &mut T)> {
        self.0.last_mut().map(|(size, value)| (&*size, value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_size_that_was_used_longest_ago_goes() {
        let mut kept = Kept::new();
        for size in 0..SIZES {
            assert!(!kept.turn_to(&size));
            kept.push(size, 10 * size);
        }
        assert!(kept.turn_to(&0) && kept.last() == Some(&0));
        assert!(!kept.turn_to(&SIZES));
        kept.push(SIZES, 1);
        assert_eq!(kept.last_mut(), Some((&SIZES, &mut 1)));
        assert!(kept.turn_to(&0) && !kept.turn_to(&1) && kept.turn_to(&2));
        assert_eq!(kept.last(), Some(&20));
    }
}
