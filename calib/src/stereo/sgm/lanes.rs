//! The vector operations of the engine, and their form for every processor.
//!
//! A disparity `d` of `count` vectors lies in lane `d / count` of vector `d % count` (as Farrar 2007 lays out the columns of an
//! alignment): its neighbours `d - 1` and `d + 1` are then the same lane of the vectors beside it, and only the two at
//! the ends are moved by a lane.
#![allow(unsafe_code)] // vectors of one processor are unsafe to use
#![allow(clippy::inline_always)] // what is not inlined is compiled for the oldest processor

/// Unsigned bytes side by side, and the 16-bit keys that are made of them.
///
/// All are `unsafe` since the forms for one processor are: they run on a processor that has their instructions, and
/// pointers reach as far as a vector does.
pub trait Lanes: Copy {
    /// Bytes of a vector.
    const LANES: usize;
    /// Half as many 16-bit keys: 8 bits of cost above 8 bits of disparity.
    type Keys: Copy;

    unsafe fn splat(value: u8) -> Self;
    /// Any address.
    unsafe fn load(from: *const u8) -> Self;
    /// Any address.
    unsafe fn store(self, to: *mut u8);
    /// A multiple of [`Lanes::LANES`]; what is written is not kept in the caches.
    unsafe fn stream(self, to: *mut u8);
    /// Sums stay below 256.
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn sub(self, other: Self) -> Self;
    unsafe fn min(self, other: Self) -> Self;
    unsafe fn or(self, other: Self) -> Self;
    /// `min(self + left, 255)`.
    unsafe fn add_saturating(self, other: Self) -> Self;
    /// `(self + other + 1) / 2`.
    unsafe fn average(self, other: Self) -> Self;
    /// Eight times values below 32.
    unsafe fn times_8(self) -> Self;
    /// `|self - other| / 4`.
    unsafe fn quarter_of_difference(self, other: Self) -> Self;
    /// In how many bits the three differ from the other three.
    unsafe fn hamming(left: [Self; 3], right: [Self; 3]) -> Self;
    /// The lesser of `self` and `other` where `place` is above `span`, else `self`.
    unsafe fn min_outside(self, other: Self, place: Self, span: Self) -> Self;
    /// Lane `j` gets lane `j - 1`; lane 0 gets `fill`'s.
    unsafe fn up(self, fill: Self) -> Self;
    /// Lane `j` gets lane `j + 1`; the last gets `fill`'s.
    unsafe fn down(self, fill: Self) -> Self;
    /// The least lane.
    unsafe fn least(self) -> u8;
    /// The least lane in all lanes.
    unsafe fn least_everywhere(self) -> Self;

    /// Keys of the lanes `self` with the disparities `of`.
    unsafe fn keys(self, of: Self) -> [Self::Keys; 2];
    /// Keys above all others.
    unsafe fn no_keys() -> [Self::Keys; 2];
    unsafe fn min_keys(a: [Self::Keys; 2], b: [Self::Keys; 2]) -> [Self::Keys; 2];
    unsafe fn least_key(keys: [Self::Keys; 2]) -> u16;
    /// The key of lane 0.
    unsafe fn first_key(keys: [Self::Keys; 2]) -> u16;
    /// As [`Lanes::down`], the last gets a key above all others.
    unsafe fn keys_down(keys: [Self::Keys; 2]) -> [Self::Keys; 2];
    /// Makes what was streamed seen by other threads.
    unsafe fn fence();
}

/// Lanes of the form for every processor.
const PLAIN: usize = 32;

/// The form for every processor.
#[derive(Clone, Copy)]
pub struct Plain([u8; PLAIN]);

impl Plain {
    #[inline(always)]
    fn each(self, other: Self, f: impl Fn(u8, u8) -> u8) -> Self {
        Self(core::array::from_fn(|j| f(self.0[j], other.0[j])))
    }
}

impl Lanes for Plain {
    const LANES: usize = PLAIN;
    type Keys = [u16; PLAIN / 2];

    #[inline(always)]
    unsafe fn splat(value: u8) -> Self {
        Self([value; PLAIN])
    }
    #[inline(always)]
    unsafe fn load(from: *const u8) -> Self {
        // SAFETY: the caller can read 32 bytes at `from`; unaligned.
        Self(unsafe { from.cast::<[u8; PLAIN]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut u8) {
        // SAFETY: the caller may write 32 bytes at `to`; unaligned.
        unsafe { to.cast::<[u8; PLAIN]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    unsafe fn stream(self, to: *mut u8) {
        // SAFETY: the caller may write 32 bytes at `to`.
        unsafe { self.store(to) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        self.each(other, u8::wrapping_add)
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        self.each(other, u8::wrapping_sub)
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        self.each(other, u8::min)
    }
    #[inline(always)]
    unsafe fn or(self, other: Self) -> Self {
        self.each(other, |a, b| a | b)
    }
    #[inline(always)]
    unsafe fn add_saturating(self, other: Self) -> Self {
        self.each(other, u8::saturating_add)
    }
    #[inline(always)]
    unsafe fn average(self, other: Self) -> Self {
        self.each(other, |a, b| (a as u16 + b as u16).div_ceil(2) as u8)
    }
    #[inline(always)]
    unsafe fn times_8(self) -> Self {
        self.each(self, |a, _| a << 3)
    }
    #[inline(always)]
    unsafe fn quarter_of_difference(self, other: Self) -> Self {
        self.each(other, |a, b| a.abs_diff(b) >> 2)
    }
    #[inline(always)]
    unsafe fn hamming(left: [Self; 3], right: [Self; 3]) -> Self {
        let bits = |i: usize, j: usize| (left[i].0[j] ^ right[i].0[j]).count_ones() as u8;
        Self(core::array::from_fn(|j| bits(0, j) + bits(1, j) + bits(2, j)))
    }
    #[inline(always)]
    unsafe fn min_outside(self, other: Self, place: Self, span: Self) -> Self {
        let outside = place.each(span, |p, s| if p > s { 0 } else { u8::MAX });
        self.each(other.each(outside, |v, o| v | o), u8::min)
    }
    #[inline(always)]
    unsafe fn up(self, fill: Self) -> Self {
        Self(core::array::from_fn(|j| if j == 0 { fill.0[0] } else { self.0[j - 1] }))
    }
    #[inline(always)]
    unsafe fn down(self, fill: Self) -> Self {
        Self(core::array::from_fn(|j| if j == PLAIN - 1 { fill.0[j] } else { self.0[j + 1] }))
    }
    #[inline(always)]
    unsafe fn least(self) -> u8 {
        self.0.iter().fold(u8::MAX, |a, b| a.min(*b))
    }
    #[inline(always)]
    unsafe fn least_everywhere(self) -> Self {
        // SAFETY: neither looks at memory, and every processor has this form.
        unsafe { Self::splat(self.least()) }
    }

    #[inline(always)]
    unsafe fn keys(self, of: Self) -> [Self::Keys; 2] {
        let key = |j: usize| u16::from(self.0[j]) << 8 | u16::from(of.0[j]);
        [core::array::from_fn(key), core::array::from_fn(|j| key(j + PLAIN / 2))]
    }
    #[inline(always)]
    unsafe fn no_keys() -> [Self::Keys; 2] {
        [[u16::MAX; PLAIN / 2]; 2]
    }
    #[inline(always)]
    unsafe fn min_keys(a: [Self::Keys; 2], b: [Self::Keys; 2]) -> [Self::Keys; 2] {
        core::array::from_fn(|h| core::array::from_fn(|j| a[h][j].min(b[h][j])))
    }
    #[inline(always)]
    unsafe fn least_key(keys: [Self::Keys; 2]) -> u16 {
        keys.iter().flatten().fold(u16::MAX, |a, b| a.min(*b))
    }
    #[inline(always)]
    unsafe fn first_key(keys: [Self::Keys; 2]) -> u16 {
        keys[0][0]
    }
    #[inline(always)]
    unsafe fn keys_down(keys: [Self::Keys; 2]) -> [Self::Keys; 2] {
        let half = PLAIN / 2;
        let at = |j: usize| if j < half { keys[0][j] } else { keys[1][j - half] };
        [
            core::array::from_fn(|j| at(j + 1)),
            core::array::from_fn(|j| if j == half - 1 { u16::MAX } else { keys[1][j + 1] }),
        ]
    }
    #[inline(always)]
    unsafe fn fence() {}
}
