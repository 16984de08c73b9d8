//! Memory whose parts start at multiples of 64 bytes, as the widest vectors ask for.

/// 64 bytes in their place.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// Zeroed bytes, aligned to 64.
#[derive(Debug)]
pub struct Aligned {
    lines: Vec<Line>,
}

impl Aligned {
    pub fn new(bytes: usize) -> Self {
        Self { lines: vec![Line([0; 64]); bytes.div_ceil(64)] }
    }

    pub fn bytes(&self) -> usize {
        self.lines.len() * 64
    }

    pub fn as_mut_ptr(&mut self) -> *mut u8 {
        self.lines.as_mut_ptr().cast()
    }

    pub fn zero(&mut self) {
        self.lines.fill(Line([0; 64]));
    }
}
