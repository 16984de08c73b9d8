//! File names by pattern, in the order that a person would put them.

/// Matches `name` and returns the text of each `*` of `pattern`; `None` when the name does not match. A `*` in front
/// takes as little as it can.
pub fn captures<'a>(pattern: &str, name: &'a str) -> Option<Vec<&'a str>> {
    let Some((prefix, rest)) = pattern.split_once('*') else {
        return (pattern == name).then(Vec::new);
    };
    let mut name = name.strip_prefix(prefix)?;
    let (middle, suffix) = rest.rsplit_once('*').map_or((None, rest), |(m, s)| (Some(m), s));
    let mut found = Vec::new();
    for literal in middle.into_iter().flat_map(|m| m.split('*')) {
        let at = name.find(literal)?;
        found.push(&name[..at]);
        name = &name[at + literal.len()..];
    }
    found.push(name.strip_suffix(suffix)?);
    Some(found)
}

/// A piece of a [`Key`]: digits count as a number, however many zeros lead.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Part {
    /// Number of digits, and the digits: compares as the number does, at any length.
    Number(usize, String),
    Text(String),
}

/// Key by which files are sorted and paired: the text that the `*` of its pattern stand for, read as people read it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key(Vec<Part>);

impl Key {
    /// The key of a name whose pattern captured `captures`.
    pub fn new(captures: &[&str]) -> Self {
        let mut parts = Vec::new();
        // A character that no file name has keeps the pieces of two `*` apart.
        for (i, mut rest) in captures.iter().copied().enumerate() {
            if i > 0 {
                parts.push(Part::Text("\0".to_owned()));
            }
            while let Some(first) = rest.chars().next() {
                let digits = first.is_ascii_digit();
                let end = rest.find(|c: char| c.is_ascii_digit() != digits).unwrap_or(rest.len());
                let (piece, after) = rest.split_at(end);
                rest = after;
                parts.push(if digits {
                    let significant = piece.trim_start_matches('0');
                    Part::Number(significant.len(), significant.to_owned())
                } else {
                    Part::Text(piece.to_owned())
                });
            }
        }
        Self(parts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn stars_capture() {
        assert_eq!(captures("rgb.png", "rgb.png"), Some(vec![]));
        assert_eq!(captures("rgb.png", "rgb.pngx"), None);
        assert_eq!(captures("color_*.png", "color_26.png"), Some(vec!["26"]));
        assert_eq!(captures("color_*.png", "color_.png"), Some(vec![""]));
        assert_eq!(captures("aba*aba", "aba"), None, "prefix and suffix may not share characters");
        assert_eq!(captures("*_c_*.png", "s1_c_c_02.png"), Some(vec!["s1", "c_02"]));
        assert_eq!(captures("a*b*", "aXbYb"), Some(vec!["X", "Yb"]));
        assert_eq!(captures("*", "ü.png"), Some(vec!["ü.png"]));
    }

    #[test]
    fn numbers_sort_as_numbers() {
        let sorted = |names: &[&str]| {
            let mut keys: Vec<_> = names.iter().map(|n| (Key::new(&[n]), (*n).to_owned())).collect();
            keys.sort();
            keys.into_iter().map(|k| k.1).collect::<Vec<_>>()
        };
        assert_eq!(sorted(&["10", "9", "0", "2", "011"]), ["0", "2", "9", "10", "011"]);
        assert_eq!(sorted(&["b1", "a10", "a2"]), ["a2", "a10", "b1"]);
        let huge = "99999999999999999999999999999";
        assert_eq!(sorted(&[huge, "3"]), ["3", huge], "more digits than any integer has");
        assert_eq!(Key::new(&["007"]), Key::new(&["7"]));
        assert_eq!(Key::new(&["0"]), Key::new(&["000"]));
        assert_ne!(Key::new(&["1", "12"]), Key::new(&["11", "2"]));
    }

    /// The textbook matcher: tries every length for every `*`.
    fn slow_match(p: &[char], n: &[char]) -> bool {
        match p.split_first() {
            None => n.is_empty(),
            Some(('*', rest)) => (0..=n.len()).any(|i| slow_match(rest, &n[i..])),
            Some((c, rest)) => n.first() == Some(c) && slow_match(rest, &n[1..]),
        }
    }

    proptest! {
        #[test]
        fn matches_what_the_slow_matcher_matches(p in "[ab*]{0,6}", n in "[ab]{0,8}") {
            let pc: Vec<_> = p.chars().collect();
            let nc: Vec<_> = n.chars().collect();
            let found = captures(&p, &n);
            prop_assert_eq!(found.is_some(), slow_match(&pc, &nc));
            if let Some(found) = found {
                // Putting the captures back gives the name.
                let mut again = String::new();
                let mut found = found.into_iter();
                for c in pc {
                    if c == '*' { again.push_str(found.next().unwrap()) } else { again.push(c) }
                }
                prop_assert_eq!(again, n);
            }
        }

        #[test]
        fn plain_numbers_order_like_integers(a in any::<u64>(), b in any::<u64>(), zeros in 0usize..4) {
            let padded = format!("{}{a}", "0".repeat(zeros));
            let ka = Key::new(&[&padded]);
            let kb = Key::new(&[&b.to_string()]);
            prop_assert_eq!(ka.cmp(&kb), a.cmp(&b));
        }
    }
}
