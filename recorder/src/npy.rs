//! NumPy's array files, <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>.
//!
//! Written and read here and not by a crate: the head is one short line of text, while the maintained crates (`npyz`,
//! `ndarray-npy`) bring about thirty others and 20 s of CPU per clean build. The tests read the files with NumPy.

/// An array, row-major.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Array<'a> {
    /// NumPy's name of its numbers, such as `<f4` for 32-bit floats.
    pub kind: &'a str,
    /// Elements in each dimension.
    pub shape: Vec<usize>,
    /// The numbers, as many as `shape` says.
    pub data: &'a [u8],
}

/// Reads an array of simple numbers out of the bytes of a file.
///
/// # Errors
/// A message that says what is wrong with the file.
pub fn read(bytes: &[u8]) -> Result<Array<'_>, String> {
    let none = || "it is not an NPY file".to_owned();
    let rest = bytes.strip_prefix(b"\x93NUMPY").ok_or_else(none)?;
    let (len, rest) = match rest {
        [1, _, a, b, rest @ ..] => (usize::from(u16::from_le_bytes([*a, *b])), rest),
        [2 | 3, _, a, b, c, d, rest @ ..] => (u32::from_le_bytes([*a, *b, *c, *d]) as usize, rest),
        _ => return Err(none()),
    };
    let (head, data) = rest.split_at_checked(len).ok_or("its head is cut off")?;
    let head = core::str::from_utf8(head).map_err(|_| none())?;
    let value = |key: &str| {
        let at = head.find(&format!("'{key}'"))? + key.len() + 2;
        Some(head[at..].trim_start().strip_prefix(':')?.trim_start())
    };
    let kind = value("descr").and_then(|v| v.strip_prefix('\'')?.split_once('\'')).map(|(kind, _)| kind);
    let kind = kind.ok_or("its head names no simple kind of number")?;
    if !value("fortran_order").is_some_and(|v| v.starts_with("False")) {
        return Err("it is stored column by column; save it with np.ascontiguousarray".to_owned());
    }
    let shape = value("shape").and_then(|v| v.strip_prefix('(')?.split_once(')')).map(|(shape, _)| shape);
    let numbers = shape.ok_or("its head has no shape")?.split(',').map(str::trim).filter(|n| !n.is_empty());
    let shape: Vec<usize> = numbers.map(|n| n.parse().map_err(|_| none())).collect::<Result<_, _>>()?;
    let element: usize = kind.get(2..).and_then(|size| size.parse().ok()).ok_or_else(|| unsupported(kind))?;
    let bytes = shape.iter().try_fold(element, |n, side| n.checked_mul(*side));
    if bytes != Some(data.len()) {
        return Err(format!("shape {shape:?} of {kind} does not fit its {} bytes", data.len()));
    }
    Ok(Array { kind, shape, data })
}

fn unsupported(kind: &str) -> String {
    format!("its numbers are {kind}, which cannot be read")
}

/// An NPY file (form 1.0) of an array of two or more dimensions, row-major; `kind` is NumPy's name of its numbers, such
/// as `<f4` for 32-bit floats.
pub fn file(kind: &str, shape: &[usize], data: &[u8]) -> Vec<u8> {
    let shape: Vec<_> = shape.iter().map(ToString::to_string).collect();
    let mut out = head(&format!("'{kind}'"), &shape.join(", "));
    out.extend_from_slice(data);
    out
}

/// The head of an NPY file of `n` records; `fields` are their names, NumPy's name of their numbers, and how many of
/// them. The records follow without padding.
pub(crate) fn records(fields: &[(&str, &str, usize)], n: u64) -> Vec<u8> {
    let fields = fields.iter().map(|(name, kind, count)| match count {
        1 => format!("('{name}', '{kind}')"),
        n => format!("('{name}', '{kind}', ({n},))"),
    });
    head(&format!("[{}]", fields.collect::<Vec<_>>().join(", ")), &format!("{n},"))
}

fn head(descr: &str, shape: &str) -> Vec<u8> {
    let mut text = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': ({shape}), }}");
    // Magic, version and length are ten bytes; the data begins at a multiple of 64, after a newline.
    let padding = (64 - (10 + text.len() + 1) % 64) % 64;
    text.extend(std::iter::repeat_n(' ', padding));
    text.push('\n');
    let mut out = Vec::with_capacity(10 + text.len());
    out.extend_from_slice(b"\x93NUMPY\x01\x00");
    out.extend_from_slice(&(text.len() as u16).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_array_is_read_as_it_was_written_and_a_part_of_it_refused() {
        let data: Vec<u8> = (0..24).collect();
        for (kind, shape) in [("|u1", &[24][..]), ("<u2", &[3, 4]), ("<f4", &[1, 2, 3]), ("<f8", &[3, 1])] {
            let bytes = file(kind, shape, &data);
            assert_eq!(read(&bytes).unwrap(), Array { kind, shape: shape.to_vec(), data: &data });
            for len in 0..bytes.len() {
                assert!(read(&bytes[..len]).is_err(), "{kind} {shape:?}: {len} bytes");
            }
        }
    }

    #[test]
    fn heads_that_lie_are_refused() {
        for (head, said) in [
            ("{'descr': '<f4', 'fortran_order': True, 'shape': (1,), }", "column by column"),
            ("{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }", "does not fit"),
            ("{'descr': '<f4', 'fortran_order': False, 'shape': (4611686018427387905,), }", "does not fit"),
            ("{'descr': '<f4', 'fortran_order': False, }", "no shape"),
            ("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }", "no simple kind"),
            ("{'descr': '|b', 'fortran_order': False, 'shape': (4,), }", "cannot be read"),
        ] {
            let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
            bytes.extend((head.len() as u16).to_le_bytes());
            bytes.extend(head.as_bytes());
            bytes.extend([0; 4]);
            let e = read(&bytes).unwrap_err();
            assert!(e.contains(said), "{head}: {e}");
        }
    }
}
