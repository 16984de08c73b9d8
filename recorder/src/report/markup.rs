//! Parts of the HTML of a report: style, escaped text, tables.

use core::fmt::Write as _;

/// The style of every report.
pub(super) const CSS: &str = include_str!("page.css");

/// Text as it stands in HTML and XML, in attributes too; control characters, which XML cannot hold, are replaced.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            '\n' | '\t' => out.push(c),
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// Begins a table; columns whose name begins with `#` are numbers.
pub fn table(out: &mut String, columns: &[&str]) {
    out.push_str("<div class=\"wide\"><table><thead><tr>");
    for name in columns {
        let _ = match name.strip_prefix('#') {
            Some(name) => write!(out, "<th class=\"n\">{name}</th>"),
            None => write!(out, "<th>{name}</th>"),
        };
    }
    out.push_str("</tr></thead><tbody>");
}

/// A row; cells are escaped here.
pub fn row(out: &mut String, columns: &[&str], cells: &[String]) {
    out.push_str("<tr>");
    for (name, cell) in columns.iter().zip(cells) {
        let class = if name.starts_with('#') { " class=\"n\"" } else { "" };
        let _ = write!(out, "<td{class}>{}</td>", escape(cell));
    }
    out.push_str("</tr>");
}

/// The end of a table.
pub const END_TABLE: &str = "</tbody></table></div>";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escaped_text_is_text_everywhere() {
        assert_eq!(escape("<script>&\"'\0\u{1b}\n"), "&lt;script&gt;&amp;&quot;&#39;\u{fffd}\u{fffd}\n");
    }
}
