//! Limits on the size of a `session.toml`, checked before parsing: each table takes some kilobytes of memory, and three
//! bytes of text are enough for one.

/// Bytes of text.
pub(crate) const TEXT_MAX_BYTES: u64 = 16 << 20;
/// Tables: `[header]`, `{ inline }`, and the ones that a key with dots makes.
const TABLES_MAX: usize = 20_000;
/// Values: what follows a `=`, a `,` or opens an array.
const VALUES_MAX: usize = 250_000;

#[derive(Debug, Default, PartialEq, Eq)]
struct Counts {
    tables: usize,
    values: usize,
}

/// The first limit of a session file that a text exceeds, in words.
pub(super) fn exceeded(text: &str) -> Option<String> {
    if text.len() as u64 > TEXT_MAX_BYTES {
        return Some(format!("it has {} bytes, {TEXT_MAX_BYTES} is the limit", text.len()));
    }
    let Counts { tables, values } = count(text.as_bytes());
    if tables > TABLES_MAX {
        return Some(format!("it has {tables} tables, {TABLES_MAX} is the limit"));
    }
    (values > VALUES_MAX).then(|| format!("it has {values} values, {VALUES_MAX} is the limit"))
}

/// Counts outside of strings and comments; the counts of invalid TOML are arbitrary.
fn count(text: &[u8]) -> Counts {
    let mut counts = Counts::default();
    let mut open = Vec::new();
    let mut is_key = true;
    let mut at = 0;
    while let Some(byte) = text.get(at) {
        at += 1;
        match byte {
            b'#' => at += text[at..].iter().position(|b| *b == b'\n').unwrap_or(text.len() - at),
            b'"' | b'\'' => at = string_end(text, at, *byte),
            b'\n' if open.is_empty() => is_key = true,
            b'[' if open.is_empty() && is_key => {
                counts.tables += 1;
                // `[[` opens one table, in an array.
                let is_array = text.get(at) == Some(&b'[');
                counts.values += usize::from(is_array);
                at += usize::from(is_array);
            }
            b'[' | b'{' => {
                counts.tables += usize::from(*byte == b'{');
                counts.values += 1;
                open.push(*byte);
                is_key = *byte == b'{';
            }
            b']' | b'}' => drop(open.pop()),
            b'=' => {
                counts.values += 1;
                is_key = false;
            }
            b',' => {
                counts.values += 1;
                is_key = open.last() == Some(&b'{');
            }
            b'.' if is_key => counts.tables += 1,
            _ => {}
        }
    }
    counts
}

/// The end of the string whose opening quote is before `at`; an unclosed one ends with its line, or the text.
fn string_end(text: &[u8], at: usize, quote: u8) -> usize {
    let long = text[at..].starts_with(&[quote, quote]);
    let mut at = if long { at + 2 } else { at };
    while let Some(byte) = text.get(at) {
        match byte {
            b'\\' if quote == b'"' => at += 2,
            b'\n' if !long => return at,
            b if *b == quote && !long => return at + 1,
            b if *b == quote && text[at..].starts_with(&[quote; 3]) => {
                // Up to two quotes may stand before the closing ones.
                let run = text[at..].iter().take(5).take_while(|b| **b == quote).count();
                return at + run;
            }
            _ => at += 1,
        }
    }
    text.len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Tables and values of parsed TOML, the slow way; the root table does not count.
    fn parsed(value: &toml::Value) -> usize {
        match value {
            toml::Value::Table(t) => 1 + t.values().map(parsed).sum::<usize>(),
            toml::Value::Array(a) => 1 + a.iter().map(parsed).sum::<usize>(),
            _ => 1,
        }
    }

    #[test]
    fn strings_and_comments_count_nothing() {
        let text = r#"
a = "x = [1, {2}] # \" ," # = , {
b = 'y\' # "
c = """
[not.a.table]
"" " \""" """""
d = '''
k = "'' ''''
[t.u]
e = [1.5, { f.g = 2.5, h = 3 }]
"#;
        assert!(toml::from_str::<toml::Table>(text).is_ok());
        // [t.u] is two, the inline one and its dotted key are two.
        assert_eq!(count(text.as_bytes()), Counts { tables: 4, values: 11 });
        for odd in ["\"", "'''", "\"\\", "a = [", "]]}}", ""] {
            let _ = count(odd.as_bytes());
        }
    }

    proptest! {
        /// Parsed TOML never has more tables or values than were counted.
        #[test]
        fn no_table_or_value_is_missed(
            lines in proptest::collection::vec(
                proptest::sample::select(vec![
                    "[a.b.c]", "[[l]]", "[[l.m]]", "x = 1", "y.z = [1.0, 2.0, [3]]", "'q.r'.s = '''\n=,[{'''",
                    "i = { j = {}, k.l = [{}, {}] }", "s = \"\"\"\n[x]\n\"\"\"", "# [c] = {", "e = []", "",
                ]),
                0..12,
            ),
        ) {
            let text = lines.join("\n");
            if let Ok(table) = toml::from_str::<toml::Table>(&text) {
                let there = parsed(&toml::Value::Table(table)) - 1;
                let counts = count(text.as_bytes());
                prop_assert!(counts.tables + counts.values >= there, "{counts:?}, {there} in {text}");
            }
        }
    }
}
