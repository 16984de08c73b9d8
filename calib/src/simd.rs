//! One loop, compiled twice: for every processor and for those with AVX2.
//!
//! The loops are written with ordinary arithmetic on slices that are parameters of their own, so that the compiler knows
//! that they do not overlap and makes vectors of what the processor has. It neither fuses nor reorders floating-point
//! operations, so both give the same bits.

/// Defines a function whose body is compiled for every processor and for those with AVX2. What the body calls must be
/// `#[inline(always)]`, else it is compiled for the oldest processor alone.
macro_rules! for_every_processor {
    ($(#[$meta:meta])* $vis:vis fn $name:ident $(<$($g:ident : $bound:path),+>)? ($($arg:ident : $ty:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments, reason = "slices that are parameters are known not to overlap")]
        #[allow(unsafe_code, reason = "what is compiled for more than the oldest processor is unsafe to call")]
        $vis fn $name $(<$($g: $bound),+>)? ($($arg: $ty),*) {
            fn plain $(<$($g: $bound),+>)? ($($arg: $ty),*) $body

            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            fn avx2 $(<$($g: $bound),+>)? ($($arg: $ty),*) $body

            #[cfg(target_arch = "x86_64")]
            if $crate::simd::has_avx2() {
                // SAFETY: the processor has AVX2.
                return unsafe { avx2($($arg),*) };
            }
            plain($($arg),*);
        }
    };
}
pub(crate) use for_every_processor;

/// Whether the wider form can run.
#[cfg(target_arch = "x86_64")]
pub(crate) fn has_avx2() -> bool {
    #[cfg(test)]
    if PLAIN.get() {
        return false;
    }
    std::arch::is_x86_feature_detected!("avx2")
}

#[cfg(test)]
thread_local! {
    /// Whether this thread's loops run in their plain form.
    pub(crate) static PLAIN: core::cell::Cell<bool> = const { core::cell::Cell::new(false) };
}
