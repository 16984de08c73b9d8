//! Vectors of AVX-512, with the byte permutation and the byte popcount that came with Ice Lake and Zen 4.
#![allow(unsafe_code)] // vectors of one processor are unsafe to use
#![allow(clippy::inline_always)] // what is not inlined is compiled for the oldest processor

use super::lanes::Lanes;
#[allow(clippy::wildcard_imports, reason = "as everybody does with intrinsics")]
use core::arch::x86_64::*;

/// 64 bytes.
#[derive(Clone, Copy)]
pub struct Avx512(__m512i);

/// The number of each lane plus `step`, modulo 64.
const fn numbers(step: i8) -> [i8; 64] {
    let mut lanes = [0; 64];
    let mut j = 0;
    while j < 64 {
        lanes[j] = (j as i8 + step) & 63;
        j += 1;
    }
    lanes
}
const BEFORE: [i8; 64] = numbers(-1);
const AFTER: [i8; 64] = numbers(1);

impl Lanes for Avx512 {
    const LANES: usize = 64;
    type Keys = __m512i;

    #[inline(always)]
    unsafe fn splat(value: u8) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_set1_epi8(value as i8) })
    }
    #[inline(always)]
    unsafe fn load(from: *const u8) -> Self {
        // SAFETY: the caller can read 64 bytes at `from`; this load asks for no alignment.
        Self(unsafe { _mm512_loadu_si512(from.cast()) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut u8) {
        // SAFETY: the caller may write 64 bytes at `to`; this store asks for no alignment.
        unsafe { _mm512_storeu_si512(to.cast(), self.0) }
    }
    #[inline(always)]
    unsafe fn stream(self, to: *mut u8) {
        // SAFETY: the caller may write 64 bytes at `to`, a multiple of 64, as this store asks.
        unsafe { _mm512_stream_si512(to.cast(), self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_add_epi8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_sub_epi8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_min_epu8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn or(self, other: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_or_si512(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn add_saturating(self, other: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_adds_epu8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn average(self, other: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_avg_epu8(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn times_8(self) -> Self {
        // No bit of a value below 32 leaves its byte.
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_slli_epi16::<3>(self.0) })
    }
    #[inline(always)]
    unsafe fn quarter_of_difference(self, other: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let difference =
                _mm512_or_si512(_mm512_subs_epu8(self.0, other.0), _mm512_subs_epu8(other.0, self.0));
            Self(_mm512_and_si512(_mm512_srli_epi16::<2>(difference), _mm512_set1_epi8(0x3f)))
        }
    }
    #[inline(always)]
    unsafe fn hamming(left: [Self; 3], right: [Self; 3]) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let a = _mm512_popcnt_epi8(_mm512_xor_si512(left[0].0, right[0].0));
            let b = _mm512_popcnt_epi8(_mm512_xor_si512(left[1].0, right[1].0));
            let c = _mm512_popcnt_epi8(_mm512_xor_si512(left[2].0, right[2].0));
            Self(_mm512_add_epi8(_mm512_add_epi8(a, b), c))
        }
    }
    #[inline(always)]
    unsafe fn min_outside(self, other: Self, place: Self, span: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let outside = _mm512_cmpgt_epu8_mask(place.0, span.0);
            Self(_mm512_mask_min_epu8(self.0, outside, self.0, other.0))
        }
    }
    #[inline(always)]
    unsafe fn up(self, fill: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG by the caller; the load is of a constant of 64 bytes, in no alignment.
        unsafe {
            let lanes = _mm512_loadu_si512(BEFORE.as_ptr().cast());
            Self(_mm512_mask_permutexvar_epi8(fill.0, !1, lanes, self.0))
        }
    }
    #[inline(always)]
    unsafe fn down(self, fill: Self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG by the caller; the load is of a constant of 64 bytes, in no alignment.
        unsafe {
            let lanes = _mm512_loadu_si512(AFTER.as_ptr().cast());
            Self(_mm512_mask_permutexvar_epi8(fill.0, !(1 << 63), lanes, self.0))
        }
    }
    #[inline(always)]
    unsafe fn least(self) -> u8 {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe { _mm_cvtsi128_si32(least(self.0)) as u8 }
    }
    #[inline(always)]
    unsafe fn least_everywhere(self) -> Self {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        Self(unsafe { _mm512_broadcastb_epi8(least(self.0)) })
    }

    #[inline(always)]
    unsafe fn keys(self, of: Self) -> [Self::Keys; 2] {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe { [_mm512_unpacklo_epi8(of.0, self.0), _mm512_unpackhi_epi8(of.0, self.0)] }
    }
    #[inline(always)]
    unsafe fn no_keys() -> [Self::Keys; 2] {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        [unsafe { _mm512_set1_epi8(-1) }; 2]
    }
    #[inline(always)]
    unsafe fn min_keys(a: [Self::Keys; 2], b: [Self::Keys; 2]) -> [Self::Keys; 2] {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe { [_mm512_min_epu16(a[0], b[0]), _mm512_min_epu16(a[1], b[1])] }
    }
    #[inline(always)]
    unsafe fn least_key(keys: [Self::Keys; 2]) -> u16 {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let all = _mm512_min_epu16(keys[0], keys[1]);
            let half = _mm256_min_epu16(_mm512_castsi512_si256(all), _mm512_extracti64x4_epi64::<1>(all));
            let last = _mm_min_epu16(_mm256_castsi256_si128(half), _mm256_extracti128_si256::<1>(half));
            _mm_cvtsi128_si32(_mm_minpos_epu16(last)) as u16
        }
    }
    #[inline(always)]
    unsafe fn first_key(keys: [Self::Keys; 2]) -> u16 {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe { _mm_cvtsi128_si32(_mm512_castsi512_si128(keys[0])) as u16 }
    }
    #[inline(always)]
    unsafe fn keys_down(keys: [Self::Keys; 2]) -> [Self::Keys; 2] {
        // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
        unsafe {
            let [low, high] = keys;
            // `low` has lanes 0 to 7 of each 16, `high` the others: 8 follows 7 there, and 16 follows 15 in the next of `low`.
            let after = _mm512_alignr_epi64::<2>(_mm512_set1_epi8(-1), low);
            [_mm512_alignr_epi8::<2>(high, low), _mm512_alignr_epi8::<2>(after, high)]
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
unsafe fn least(v: __m512i) -> __m128i {
    // SAFETY: AVX-512 with VBMI and BITALG, which the caller has seen that the processor has; nothing but registers.
    unsafe {
        let half = _mm256_min_epu8(_mm512_castsi512_si256(v), _mm512_extracti64x4_epi64::<1>(v));
        let last = _mm_min_epu8(_mm256_castsi256_si128(half), _mm256_extracti128_si256::<1>(half));
        _mm_minpos_epu16(_mm_min_epu8(last, _mm_srli_epi16::<8>(last)))
    }
}
