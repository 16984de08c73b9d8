//! EBML elements as bytes. RFC 8794.

/// A size in so few bytes as it needs.
pub fn size(n: u64) -> Vec<u8> {
    // All bits set stands for "unknown", so a length holds one less.
    let len = (1..=8).find(|len| n < (1 << (7 * len)) - 1).unwrap();
    vint(n, len)
}

/// A number in `len` bytes.
pub fn vint(n: u64, len: usize) -> Vec<u8> {
    let marked = n | 1 << (7 * len);
    marked.to_be_bytes()[8 - len..].to_vec()
}

/// An identifier.
pub fn id(of: u32) -> Vec<u8> {
    let bytes = of.to_be_bytes();
    bytes[of.leading_zeros() as usize / 8..].to_vec()
}

/// An element.
pub fn element(of: u32, body: &[u8]) -> Vec<u8> {
    [id(of), size(body.len() as u64), body.to_vec()].concat()
}

/// An element of elements.
pub fn master(of: u32, children: &[Vec<u8>]) -> Vec<u8> {
    element(of, &children.concat())
}

/// An element with an unsigned number.
pub fn uint(of: u32, n: u64) -> Vec<u8> {
    let bytes = n.to_be_bytes();
    element(of, &bytes[(n.leading_zeros() as usize / 8).min(7)..])
}

/// An element with an unsigned number of eight bytes, which can be changed later.
pub fn uint8(of: u32, n: u64) -> Vec<u8> {
    element(of, &n.to_be_bytes())
}

/// An element with text.
pub fn text(of: u32, text: &str) -> Vec<u8> {
    element(of, text.as_bytes())
}
