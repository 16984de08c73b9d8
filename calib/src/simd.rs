//! One loop, compiled for every processor, for those with AVX2 and for those with AVX-512.
//!
//! The loops are written with ordinary arithmetic on slices that are parameters of their own, so that the compiler knows
//! that they do not overlap and makes vectors of what the processor has. It neither fuses nor reorders floating-point
//! operations, so all give the same bits.

/// Defines a function whose body is compiled once for each [`Width`]. What the body calls must be `#[inline(always)]`,
/// else it is compiled for the oldest processor alone.
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
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
            fn avx512 $(<$($g: $bound),+>)? ($($arg: $ty),*) $body

            match $crate::simd::width() {
                // SAFETY: the processor has it.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Width::Avx512 => unsafe { avx512($($arg),*) },
                // SAFETY: the processor has it.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Width::Avx2 => unsafe { avx2($($arg),*) },
                $crate::simd::Width::Plain => plain($($arg),*),
            }
        }
    };
}
pub(crate) use for_every_processor;

/// Vector width for which a loop is compiled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Width {
    /// Every one.
    Plain,
    /// Those with 256-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// Those with 512-bit vectors of any number.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

/// The widest form that the processor has.
pub(crate) fn width() -> Width {
    #[cfg(test)]
    if let Some(width) = FORCED.get() {
        return width;
    }
    widest()
}

/// Detects the processor's vectors; the standard library caches the answer.
fn widest() -> Width {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::is_x86_feature_detected as has;
        if has!("avx512f") && has!("avx512bw") && has!("avx512dq") && has!("avx512vl") {
            return Width::Avx512;
        }
        if has!("avx2") {
            return Width::Avx2;
        }
    }
    Width::Plain
}

#[cfg(test)]
thread_local! {
    static FORCED: core::cell::Cell<Option<Width>> = const { core::cell::Cell::new(None) };
}

/// Runs `work` on this thread in each form that the processor has.
#[cfg(test)]
pub(crate) fn in_every_width(mut work: impl FnMut(Width)) {
    let mut widths = vec![Width::Plain];
    #[cfg(target_arch = "x86_64")]
    widths.extend([Width::Avx2, Width::Avx512].into_iter().filter(|w| *w <= widest()));
    for width in widths {
        FORCED.set(Some(width));
        work(width);
    }
    FORCED.set(None);
}
