//! A choice of scenes by name.

use super::Place;
use anyhow::{Result, bail};

/// Names of scenes or sequences, with `*` and `?`; none is all.
#[derive(Debug, Clone, Default)]
pub struct Scenes(Vec<String>);

impl Scenes {
    /// Those of the command line.
    pub fn new(patterns: &[String]) -> Self {
        Self(patterns.to_vec())
    }

    /// Whether all are meant.
    pub const fn is_all(&self) -> bool {
        self.0.is_empty()
    }

    /// Keeps the chosen items.
    ///
    /// # Errors
    /// When a name matches none; it says which there are.
    pub fn keep<T>(&self, items: Vec<T>, place: impl Fn(&T) -> &Place) -> Result<Vec<T>> {
        if self.is_all() {
            return Ok(items);
        }
        let is_in = |pattern: &str, p: &Place| matches(pattern, &p.scene) || matches(pattern, &p.sequence);
        for pattern in &self.0 {
            if !items.iter().any(|i| is_in(pattern, place(i))) {
                let mut there: Vec<&str> = items.iter().map(|i| place(i).scene.as_str()).collect();
                there.sort_unstable();
                there.dedup();
                let more = if there.len() > 12 { ", …" } else { "" };
                there.truncate(12);
                bail!("no scene or sequence {pattern}; there are {}{more}", there.join(", "));
            }
        }
        Ok(items.into_iter().filter(|i| self.0.iter().any(|p| is_in(p, place(i)))).collect())
    }
}

/// Whether all of `text` is `pattern`, in which `*` is any text and `?` any character.
fn matches(pattern: &str, text: &str) -> bool {
    let pattern: Vec<char> = pattern.chars().collect();
    let text: Vec<char> = text.chars().collect();
    let mut reached = vec![false; text.len() + 1];
    reached[0] = true;
    for p in pattern {
        let mut next = vec![false; text.len() + 1];
        for i in 0..=text.len() {
            next[i] = match p {
                '*' => reached[i] || (i > 0 && next[i - 1]),
                _ => i > 0 && reached[i - 1] && (p == '?' || p == text[i - 1]),
            };
        }
        reached = next;
    }
    reached[text.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_match_whole_names() {
        for (pattern, text) in [
            ("a", "a"),
            ("*", ""),
            ("*", "x"),
            ("scene1?", "scene12"),
            ("*_naked*", "s_naked_1"),
            ("a*b*c", "aXbYbc"),
        ] {
            assert!(matches(pattern, text), "{pattern} {text}");
        }
        for (pattern, text) in [("a", "ab"), ("scene1", "scene12"), ("?", ""), ("", "a"), ("a*b", "abc")] {
            assert!(!matches(pattern, text), "{pattern} {text}");
        }
    }

    #[test]
    fn a_name_that_matches_nothing_is_an_error_with_the_names_there_are() {
        let place =
            |scene: &str| Place { scene: scene.into(), sequence: format!("{scene}_1"), ..Place::default() };
        let all = vec![place("a"), place("b")];
        let keep = |p: &[&str]| {
            let patterns: Vec<String> = p.iter().map(|t| (*t).to_owned()).collect();
            Scenes::new(&patterns).keep(all.clone(), |p| p)
        };
        assert_eq!(keep(&[]).unwrap().len(), 2);
        assert_eq!(keep(&["b_?"]).unwrap(), [place("b")]);
        let error = keep(&["a", "c"]).unwrap_err().to_string();
        assert_eq!(error, "no scene or sequence c; there are a, b");
    }
}
