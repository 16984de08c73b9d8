//! Texts in zero-padded fields of headers and records.

use crate::{Error, ErrorKind, Result};

/// Writes `text` into a field, cut at a character boundary so that at least one zero byte is left.
pub(crate) fn set<const N: usize>(field: &mut [u8; N], text: &str) {
    let end = text.floor_char_boundary(N - 1);
    *field = [0; N];
    field[..end].copy_from_slice(&text.as_bytes()[..end]);
}

/// The text of a field; an invalid tail is left out.
pub(crate) fn valid_part(field: &[u8]) -> &str {
    let len = field.iter().position(|b| *b == 0).unwrap_or(field.len());
    match core::str::from_utf8(&field[..len]) {
        Ok(s) => s,
        Err(e) => core::str::from_utf8(&field[..e.valid_up_to()]).unwrap_or_default(),
    }
}

/// The text of field `name`, checked.
///
/// # Errors
/// [`ErrorKind::Other`] when it does not end with a zero byte, has something behind it, is not UTF-8, or has control
/// characters, which would spoil a log.
pub(crate) fn get<'a, const N: usize>(field: &'a [u8; N], name: &str) -> Result<&'a str> {
    let wrong = |what: &str| Error::new(ErrorKind::Other, format!("its field `{name}` {what}"));
    let Some(len) = field.iter().position(|b| *b == 0) else {
        return Err(wrong("does not end with a zero byte"));
    };
    if field[len..].iter().any(|b| *b != 0) {
        return Err(wrong("has bytes after its end"));
    }
    let text = core::str::from_utf8(&field[..len]).map_err(|e| wrong("is not UTF-8").with_source(e))?;
    if text.chars().any(char::is_control) {
        return Err(wrong("has control characters"));
    }
    Ok(text)
}

/// The text of a field for display; bytes that are not text are left out.
pub(crate) fn shown<const N: usize>(field: &[u8; N]) -> String {
    let len = field.iter().position(|b| *b == 0).unwrap_or(N);
    String::from_utf8_lossy(&field[..len]).chars().filter(|c| !c.is_control()).collect()
}
