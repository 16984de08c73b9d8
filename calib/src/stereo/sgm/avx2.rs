//! Vectors of AVX2.
#![allow(unsafe_code)] // vectors of one processor are unsafe to use
#![allow(clippy::inline_always)] // what is not inlined is compiled for the oldest processor

use super::lanes::Lanes;
#[allow(clippy::wildcard_imports, reason = "as everybody does with intrinsics")]
use core::arch::x86_64::*;

/// 32 bytes.
#[derive(Clone, Copy)]
pub struct Avx2(__m256i);

impl Lanes for Avx2 {
    const LANES: usize = 32;
    type Keys = __m256i;

    #[inline(always)]
    unsafe fn splat(value: u8) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_set1_epi8(value as i8) })
    }
    #[inline(always)]
    unsafe fn load(from: *const u8) -> Self {
        // SAFETY: the caller can read 32 bytes at `from`; this load asks for no alignment.
        Self(unsafe { _mm256_loadu_si256(from.cast()) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut u8) {
        // SAFETY: the caller may write 32 bytes at `to`; this store asks for no alignment.
        unsafe { _mm256_storeu_si256(to.cast(), self.0) }
    }
    #[inline(always)]
    unsafe fn stream(self, to: *mut u8) {
        // SAFETY: the caller may write 32 bytes at `to`, a multiple of 32, as this store asks.
        unsafe { _mm256_stream_si256(to.cast(), self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_add_epi8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_sub_epi8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_min_epu8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn or(self, other: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_or_si256(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn add_saturating(self, other: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_adds_epu8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn average(self, other: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_avg_epu8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn times_8(self) -> Self {
        // No bit of a value below 32 leaves its byte.
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_slli_epi16::<3>(self.0) })
    }
    #[inline(always)]
    unsafe fn quarter_of_difference(self, other: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let difference =
                _mm256_or_si256(_mm256_subs_epu8(self.0, other.0), _mm256_subs_epu8(other.0, self.0));
            Self(_mm256_and_si256(_mm256_srli_epi16::<2>(difference), _mm256_set1_epi8(0x3f)))
        }
    }
    #[inline(always)]
    unsafe fn hamming(left: [Self; 3], right: [Self; 3]) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let a = _mm256_xor_si256(left[0].0, right[0].0);
            let b = _mm256_xor_si256(left[1].0, right[1].0);
            let c = _mm256_xor_si256(left[2].0, right[2].0);
            // A full adder: three bits of one weight are one of it and one of twice it.
            let half = _mm256_xor_si256(a, b);
            let ones = _mm256_xor_si256(half, c);
            let twos = _mm256_or_si256(_mm256_and_si256(a, b), _mm256_and_si256(half, c));
            let low = _mm256_set1_epi8(0x0f);
            let count = _mm256_setr_epi8(
                0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3,
                4,
            );
            let double = _mm256_add_epi8(count, count);
            let a = _mm256_shuffle_epi8(count, _mm256_and_si256(ones, low));
            let b = _mm256_shuffle_epi8(count, _mm256_and_si256(_mm256_srli_epi16::<4>(ones), low));
            let c = _mm256_shuffle_epi8(double, _mm256_and_si256(twos, low));
            let d = _mm256_shuffle_epi8(double, _mm256_and_si256(_mm256_srli_epi16::<4>(twos), low));
            Self(_mm256_add_epi8(_mm256_add_epi8(a, b), _mm256_add_epi8(c, d)))
        }
    }
    #[inline(always)]
    unsafe fn min_outside(self, other: Self, place: Self, span: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let inside = _mm256_cmpeq_epi8(_mm256_min_epu8(place.0, span.0), place.0);
            Self(_mm256_min_epu8(self.0, _mm256_or_si256(other.0, inside)))
        }
    }
    #[inline(always)]
    unsafe fn up(self, fill: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let before = _mm256_permute2x128_si256::<0x20>(fill.0, self.0);
            // Byte 15 of `before` is taken: any of a splat.
            Self(_mm256_alignr_epi8::<15>(self.0, before))
        }
    }
    #[inline(always)]
    unsafe fn down(self, fill: Self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let after = _mm256_permute2x128_si256::<0x21>(self.0, fill.0);
            Self(_mm256_alignr_epi8::<1>(after, self.0))
        }
    }
    #[inline(always)]
    unsafe fn least(self) -> u8 {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe { _mm_cvtsi128_si32(least(self.0)) as u8 }
    }
    #[inline(always)]
    unsafe fn least_everywhere(self) -> Self {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm256_broadcastb_epi8(least(self.0)) })
    }

    #[inline(always)]
    unsafe fn keys(self, of: Self) -> [Self::Keys; 2] {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe { [_mm256_unpacklo_epi8(of.0, self.0), _mm256_unpackhi_epi8(of.0, self.0)] }
    }
    #[inline(always)]
    unsafe fn no_keys() -> [Self::Keys; 2] {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        [unsafe { _mm256_set1_epi8(-1) }; 2]
    }
    #[inline(always)]
    unsafe fn min_keys(a: [Self::Keys; 2], b: [Self::Keys; 2]) -> [Self::Keys; 2] {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe { [_mm256_min_epu16(a[0], b[0]), _mm256_min_epu16(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn least_key(keys: [Self::Keys; 2]) -> u16 {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let both = _mm256_min_epu16(keys[0], keys[1]);
            let half = _mm_min_epu16(_mm256_castsi256_si128(both), _mm256_extracti128_si256::<1>(both));
            _mm_cvtsi128_si32(_mm_minpos_epu16(half)) as u16
        }
    }
    #[inline(always)]
    unsafe fn first_key(keys: [Self::Keys; 2]) -> u16 {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe { _mm_cvtsi128_si32(_mm256_castsi256_si128(keys[0])) as u16 }
    }
    #[inline(always)]
    unsafe fn keys_down(keys: [Self::Keys; 2]) -> [Self::Keys; 2] {
        // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let [low, high] = keys;
            // Lanes 0 to 7 and 16 to 23 are in `low`, so that 8 follows 7 in `high`, and 16 follows 15 in `low`.
            let after = _mm256_permute2x128_si256::<0x21>(low, _mm256_set1_epi8(-1));
            [_mm256_alignr_epi8::<2>(high, low), _mm256_alignr_epi8::<2>(after, high)]
        }
    }
    #[inline(always)]
    unsafe fn fence() {
        // SAFETY: touches no memory of ours; every x86-64 has it.
        unsafe { _mm_sfence() }
    }
}

/// The least byte, in byte 0.
#[inline(always)]
unsafe fn least(v: __m256i) -> __m128i {
    // SAFETY: AVX2, which the caller has seen that the processor has; nothing but registers.
    unsafe {
        let half = _mm_min_epu8(_mm256_castsi256_si128(v), _mm256_extracti128_si256::<1>(v));
        _mm_minpos_epu16(_mm_min_epu8(half, _mm_srli_epi16::<8>(half)))
    }
}
