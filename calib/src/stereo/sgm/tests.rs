//! The passes beside the model, in every form that the processor has; the filters beside plain ones. Long
//! because each pass has a model of its own here.

use super::super::Preset;
use super::kernel::Winner;
use super::model::{self, Image};
use super::*;
use proptest::prelude::*;

fn forms() -> Vec<Form> {
    let mut forms = vec![Form::Plain];
    #[cfg(target_arch = "x86_64")]
    forms.extend([Form::Avx2, Form::Avx512].into_iter().filter(|f| *f <= Form::best()));
    forms
}

/// Numbers that look random, the same for a seed.
fn noise(seed: u64) -> impl FnMut() -> u8 {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 24) as u8
    }
}

/// A pair with structure: smooth, noisy and saturated parts, shifted by a disparity that changes with the row.
fn pair(w: usize, h: usize, stride: usize, seed: u64) -> [Vec<u8>; 2] {
    let mut next = noise(seed);
    let mut left = vec![0; stride * h];
    let mut right = vec![0; stride * h];
    for y in 0..h {
        let kind = next() % 4;
        let shift = usize::from(next()) % w.max(2);
        let row: Vec<u8> = (0..2 * w)
            .map(|x| match kind {
                0 => next(),
                1 => (x * 5 + y) as u8,
                2 => 255 * (next() & 1),
                _ => 128 + (next() & 3),
            })
            .collect();
        left[y * stride..][..w].copy_from_slice(&row[..w]);
        right[y * stride..][..w].copy_from_slice(&row[shift.min(w)..][..w]);
        // The bytes between rows belong to no image.
        left[y * stride + w..(y + 1) * stride].fill(next());
    }
    [left, right]
}

fn check_passes(w: usize, h: usize, extra: usize, costs: Costs, threads: usize, seed: u64) {
    let stride = w + extra;
    let [left, right] = pair(w, h, stride, seed);
    let image = |pixels| Image { pixels, width: w, height: h, stride };
    let want = model::winners(&image(&left), &image(&right), &costs);
    let gray = |pixels| Gray { pixels, width: w, height: h, stride };
    let pair = StereoPair::new(gray(&left), gray(&right));
    let pool = (threads > 1).then(|| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap());
    for form in forms() {
        let mut passes = Passes::new(form, (w, h), costs, threads);
        // The second time, memory is not zero any more.
        for _ in 0..2 {
            let (winners, mirrored) = passes.run(&pair, pool.as_ref());
            let case = format!("{form:?} {w}x{h}+{extra} {costs:?} {threads} threads");
            if let Some(i) = (0..w * h).find(|i| winners[*i] != want.0[*i]) {
                panic!("{case}: pixel {}, {}: {:?}, not {:?}", i % w, i / w, winners[i], want.0[i]);
            }
            assert_eq!(mirrored, want.1, "{case}");
        }
    }
}

const COSTS: Costs = Costs { disparities: 64, small: 6, large: Penalties { most: 50, least: 15, slack: 4 } };

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, ..ProptestConfig::default() })]

    #[test]
    fn the_passes_find_what_the_model_finds(
        (w, h, extra) in (1_usize..70, 1_usize..14, 0_usize..9),
        disparities in 1_usize..=256,
        (small, least, most) in (1_u8..=63, 0_u8..=63, 0_u8..=63),
        slack in 0_u8..=255,
        threads in 1_usize..4,
        seed in any::<u64>(),
    ) {
        let least = least.max(small);
        let large = Penalties { most: most.max(least), least, slack };
        check_passes(w, h, extra, Costs { disparities, small, large }, threads, seed);
    }
}

#[test]
fn every_number_of_vectors_and_every_edge() {
    for disparities in [1, 2, 31, 32, 33, 63, 64, 65, 96, 127, 128, 129, 160, 161, 192, 193, 255, 256] {
        check_passes(41, 5, 3, Costs { disparities, ..COSTS }, 1, disparities as u64);
    }
    for (w, h) in [(1, 1), (1, 9), (9, 1), (2, 2), (3, 5), (300, 3)] {
        check_passes(w, h, 0, COSTS, 1, 7);
        check_passes(w, h, 1, Costs { disparities: 256, ..COSTS }, 3, 8);
    }
}

#[test]
fn threads_change_nothing() {
    // Wide enough that rows wait for each other within a row.
    for threads in [2, 3, 5] {
        check_passes(333, 11, 0, Costs { disparities: 40, ..COSTS }, threads, 3);
    }
}

#[test]
fn sums_beyond_a_byte_stop_at_255() {
    // Penalties at their largest on noise: eight paths of up to 63.
    let large = Penalties { most: 63, least: 63, slack: 255 };
    check_passes(60, 12, 0, Costs { disparities: 128, small: 63, large }, 1, 11);
}

fn map_of(w: usize, h: usize, seed: u64, holes: u8) -> Vec<u16> {
    let mut next = noise(seed);
    (0..w * h)
        .map(|_| if next() < holes { NONE } else { u16::from(next() % 8) * 96 + u16::from(next() % 3) })
        .collect()
}

proptest! {
    #[test]
    fn the_median_is_the_fifth_of_nine(w in 1_usize..40, h in 1_usize..9, seed in any::<u64>(), holes in 0_u8..200) {
        let map = map_of(w, h, seed, holes);
        let mut out = vec![0; w * h];
        filter::median(w, &map, &mut out);
        for (i, got) in out.iter().enumerate() {
            let x = i % w;
            let y = i / w;
            let inside = x > 0 && y > 0 && x + 1 < w && y + 1 < h;
            if !inside {
                prop_assert_eq!(*got, map[i]);
                continue;
            }
            let mut nine: Vec<u16> = (0..9).map(|k| map[(y + k / 3 - 1) * w + x + k % 3 - 1]).collect();
            if map[i] == NONE {
                nine.retain(|v| *v != NONE);
                nine.sort_unstable_by(|a, b| b.cmp(a));
                let fifth = nine.get(4).copied().filter(|v| *v > 0);
                prop_assert_eq!(*got, fifth.unwrap_or(NONE));
                continue;
            }
            nine.iter_mut().filter(|v| **v == NONE).for_each(|v| *v = map[i]);
            nine.sort_unstable();
            prop_assert_eq!(*got, nine[4]);
        }
    }

    #[test]
    fn speckles_are_small_regions(w in 1_usize..40, h in 1_usize..12, seed in any::<u64>(), most in 0_u32..40, step in 0_u16..200) {
        let map = map_of(w, h, seed, 60);
        let mut got = map.clone();
        let mut sure = vec![9; w * h];
        Speckle::new(w * h).remove(w, &mut got, &mut sure, most, step);
        // A region by flooding from each pixel.
        for i in 0..w * h {
            let mut seen = vec![false; w * h];
            let mut todo = vec![i];
            seen[i] = true;
            while let Some(p) = todo.pop() {
                let x = p % w;
                let y = p / w;
                let beside = [(x > 0, p.wrapping_sub(1)), (x + 1 < w, p + 1), (y > 0, p.wrapping_sub(w)), (y + 1 < h, p + w)];
                for q in beside.into_iter().filter(|b| b.0).map(|b| b.1) {
                    if map[p] != NONE && map[q] != NONE && map[p].abs_diff(map[q]) <= step && !seen[q] {
                        seen[q] = true;
                        todo.push(q);
                    }
                }
            }
            let size = seen.iter().filter(|s| **s).count() as u32;
            let want = if map[i] != NONE && size <= most { NONE } else { map[i] };
            prop_assert_eq!((got[i], sure[i] == 0), (want, want == NONE && map[i] != NONE), "pixel {}", i);
        }
    }

    #[test]
    fn only_short_gaps_between_equals_are_filled(w in 1_usize..40, h in 1_usize..12, seed in any::<u64>(), most in 0_usize..6, step in 0_u16..300) {
        let map = map_of(w, h, seed, 120);
        let mut got = map.clone();
        let mut sure = vec![9; w * h];
        filter::fill_gaps(w, &mut got, &mut sure, most, step, &mut vec![7; w]);
        // Along one line: the ends of the gap that contains `i`, if it is one.
        let gap = |line: &[u16], i: usize| -> Option<u16> {
            let before = line[..i].iter().rposition(|v| *v != NONE)?;
            let after = i + line[i..].iter().position(|v| *v != NONE)?;
            let a = line[before];
            let b = line[after];
            (after - before - 1 <= most && a.abs_diff(b) <= step).then(|| {
                let way = (f64::from(b) - f64::from(a)) * (i - before) as f64 / (after - before) as f64;
                (f64::from(a) + way.trunc()) as u16
            })
        };
        let mut rows = map.clone();
        for i in (0..w * h).filter(|i| map[*i] == NONE) {
            let row = &map[i / w * w..][..w];
            rows[i] = gap(row, i % w).unwrap_or(NONE);
        }
        for i in 0..w * h {
            let column: Vec<u16> = rows.iter().skip(i % w).step_by(w).copied().collect();
            let want = if rows[i] == NONE { gap(&column, i / w).unwrap_or(NONE) } else { rows[i] };
            prop_assert_eq!(got[i], want, "pixel {}", i);
            prop_assert_eq!(sure[i], if map[i] == NONE && want != NONE { 1 } else { 9 });
        }
    }

    #[test]
    fn half_is_the_mean_of_four(w in 1_usize..20, h in 1_usize..9, extra in 0_usize..4, seed in any::<u64>()) {
        let mut next = noise(seed);
        let pixels: Vec<u8> = (0..(w + extra) * h).map(|_| next()).collect();
        let image = Image { pixels: &pixels, width: w, height: h, stride: w + extra };
        let mut out = vec![0; w.div_ceil(2) * h.div_ceil(2)];
        filter::halve(&Gray { pixels: &pixels, width: w, height: h, stride: w + extra }, &mut out);
        for (i, got) in out.iter().enumerate() {
            let x = 2 * (i % w.div_ceil(2)) as isize;
            let y = 2 * (i / w.div_ceil(2)) as isize;
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].iter().map(|(i, j)| image.at(x + i, y + j)).sum::<i32>();
            prop_assert_eq!(i32::from(*got), (four + 2) / 4);
        }
    }
}

#[test]
fn doubling_goes_on_a_plane_and_keeps_edges() {
    // Disparity 10 + x/4 on the left, a step to 40, a hole at the end.
    let w = 12;
    let h = 4;
    let value = |x: usize| {
        if x == 11 {
            NONE
        } else if x < 6 {
            10 * ONE + x as u16 * 64
        } else {
            40 * ONE
        }
    };
    let map: Vec<u16> = (0..w * h).map(|i| value(i % w)).collect();
    let sure: Vec<u8> = (0..w * h).map(|i| (i % w) as u8).collect();
    let mut out = vec![0; 23 * 7];
    let mut out_sure = vec![0; 23 * 7];
    filter::double((w, h), (&map, &sure), (23, 7), &mut out, &mut out_sure);
    let row: Vec<f32> = out[3 * 23..4 * 23].iter().map(|d| f32::from(*d) / 256.0).collect();
    // Pixel 5 of the full image lies at 2.25 of the half one: twice 10.5625.
    assert_eq!((row[4], row[5]), (20.875, 21.125));
    assert_eq!((row[11], row[12]), (22.5, 80.0));
    assert_eq!(out[3 * 23 + 22], NONE);
    assert_eq!((out_sure[0], out_sure[23 + 9]), (0, 4));
}

#[test]
fn the_fit_meets_between() {
    let parameters = Parameters::preset(Preset::Quality, 64);
    let row = |winner: Winner| {
        let mut out = [0; 30];
        let mut sure = [0; 30];
        choose::choose(&[winner; 30], &[winner.disparity; 30], &parameters, 63, &mut out, &mut sure);
        (out[29], sure[29], out[19])
    };
    let w = Winner { disparity: 20, cost: 10, before: 30, after: 30, second: 60 };
    // Left of column 20 it would lead out of the image.
    assert_eq!(row(w), (20 * ONE, 101, NONE));
    // Costs rise by 20 to the left and by 10 to the right: the tip lies a quarter towards the right.
    assert_eq!(row(Winner { after: 20, ..w }).0, 20 * ONE + 64);
    assert_eq!(row(Winner { before: 10, after: 10, ..w }).0, 20 * ONE);
    assert_eq!(row(Winner { before: 10, after: 50, ..w }).0, 20 * ONE - 128);
    assert_eq!(row(Winner { disparity: 0, before: 255, after: 10, ..w }).0, 0);
    assert_eq!(row(Winner { second: 10, ..w }).1, 1);
}

#[test]
fn views_that_disagree_give_nothing() {
    let winner = Winner { disparity: 3, cost: 10, before: 30, after: 30, second: 20 };
    let mut parameters = Parameters::preset(Preset::Quality, 64);
    let valid = |parameters: &Parameters, mirrored: u8| {
        let mut out = [0; 8];
        let mut sure = [0; 8];
        choose::choose(&[winner; 8], &[mirrored; 8], parameters, 63, &mut out, &mut sure);
        assert_eq!(out[7] == NONE, sure[7] == 0);
        out[7] != NONE
    };
    parameters.left_right_px = 1;
    assert!(valid(&parameters, 4) && valid(&parameters, 2));
    assert!(!valid(&parameters, 5) && !valid(&parameters, 1));
    parameters.uniqueness_percent = 100;
    assert!(valid(&parameters, 3));
    parameters.uniqueness_percent = 101;
    assert!(!valid(&parameters, 3));
}

#[test]
fn what_the_right_view_matches_is_taken_where_the_views_disagree() {
    // All pixels of the left view say 9; what the right view says follows.
    let winner = Winner { disparity: 9, cost: 10, before: 30, after: 30, second: 20 };
    let rematched = |mirrored: [u8; 6], uniqueness: u8| {
        let mut parameters = Parameters::preset(Preset::Quality, 64);
        parameters.uniqueness_percent = uniqueness;
        let mut out = [0; 6];
        let mut sure = [0; 6];
        choose::choose(&[winner; 6], &mirrored, &parameters, 63, &mut out, &mut sure);
        choose::rematch(&[winner; 6], &mirrored, 2, &mut out, &mut sure);
        (out.map(|d| if d == NONE { None } else { Some(d / ONE) }), sure)
    };
    // Nobody reaches left of column 9, so all disagree. Pixel 0 claims 3 and pixel 1 claims 4 for columns 3 and 5, pixel 2
    // claims 1 for column 3 too: the nearer stays. What is claimed beyond the image is nobody's.
    let (found, sure) = rematched([3, 4, 1, 60, 200, 255], 0);
    assert_eq!(found, [None, None, None, Some(3), None, Some(4)]);
    assert_eq!(sure, [0, 0, 0, 1, 0, 1]);

    // The same disparity, but refused since it is not unique: stays refused. 3 more or less counts as another.
    let winner = Winner { disparity: 1, cost: 10, before: 30, after: 30, second: 10 };
    let mut parameters = Parameters::preset(Preset::Quality, 64);
    parameters.uniqueness_percent = 50;
    for (claimed, taken) in [(1, false), (3, false), (4, true)] {
        let mut out = [0; 8];
        let mut sure = [0; 8];
        let mut mirrored = [1; 8];
        mirrored[2] = claimed;
        choose::choose(&[winner; 8], &mirrored, &parameters, 63, &mut out, &mut sure);
        assert!(out.iter().all(|d| *d == NONE));
        choose::rematch(&[winner; 8], &mirrored, 2, &mut out, &mut sure);
        let found: Vec<usize> = (0..8).filter(|x| out[*x] != NONE).collect();
        assert_eq!(found, if taken { vec![2 + usize::from(claimed)] } else { vec![] }, "{claimed}");
    }
}

#[test]
fn the_matcher_rematches_when_told() {
    let with = |rematch: bool| {
        let mut parameters = Parameters::preset(Preset::Quality, 48);
        (parameters.speckle_px, parameters.gap_px, parameters.median_rounds) = (0, 0, 0);
        parameters.rematch = rematch;
        matched(&parameters, (90, 30), 1, Form::best())
    };
    let without = with(false);
    let with = with(true);
    let added: Vec<usize> =
        (0..90 * 30).filter(|i| with.disparity[*i].to_bits() != without.disparity[*i].to_bits()).collect();
    assert!(!added.is_empty());
    assert!(added.iter().all(|i| without.disparity[*i].is_nan() && with.confidence[*i] == 1));
}

#[test]
fn doubling_keeps_a_step_of_more_than_a_pixel() {
    for (step, kept) in [(ONE, false), (ONE + 1, true)] {
        let map = [10 * ONE, 10 * ONE + step];
        let mut out = [0; 8];
        let mut sure = [0; 8];
        filter::double((2, 1), (&map, &[7, 7]), (4, 2), &mut out, &mut sure);
        assert_eq!(out[1] == 20 * ONE, kept, "{step}");
    }
}

#[test]
fn the_median_is_taken_as_often_as_is_said() {
    let size = (90, 30);
    let with = |rounds: u8| {
        let mut parameters = Parameters::preset(Preset::Quality, 48);
        (parameters.speckle_px, parameters.gap_px, parameters.median_rounds) = (0, 0, rounds);
        matched(&parameters, size, 1, Form::best())
    };
    let units = |map: &DisparityMap| -> Vec<u16> {
        let unit = |d: &f32| if d.is_nan() { NONE } else { (d * f32::from(ONE)) as u16 };
        map.disparity.iter().map(unit).collect()
    };
    let mut want = units(&with(0));
    for rounds in 1..4 {
        let before = want.clone();
        filter::median(size.0, &before, &mut want);
        assert_ne!(before, want);
        let got = with(rounds);
        assert_eq!(units(&got), want, "{rounds}");
        assert!(got.disparity.iter().zip(&got.confidence).all(|(d, c)| d.is_nan() == (*c == 0)));
    }
}

/// Bits, since NaN is not equal to itself.
fn bits(map: &DisparityMap) -> (Vec<u32>, Vec<u8>) {
    (map.disparity.iter().map(|d| d.to_bits()).collect(), map.confidence.clone())
}

fn matched(parameters: &Parameters, (w, h): (usize, usize), threads: usize, form: Form) -> DisparityMap {
    let [left, right] = pair(w, h, w + 3, 5);
    let gray = |pixels| Gray { pixels, width: w, height: h, stride: w + 3 };
    let mut matcher = SgmMatcher::with_form(w, h, parameters, threads, form).unwrap();
    let mut out = DisparityMap::default();
    matcher.run(&StereoPair::new(gray(&left), gray(&right)), &mut out).unwrap();
    let first = out.clone();
    matcher.run(&StereoPair::new(gray(&left), gray(&right)), &mut out).unwrap();
    assert_eq!(bits(&first), bits(&out), "the second pair of a matcher");
    out
}

#[test]
fn presets_are_the_same_in_every_form_and_with_every_number_of_threads() {
    for preset in Preset::ALL {
        for size in [(1, 1), (2, 3), (37, 21), (150, 40)] {
            let parameters = Parameters::preset(preset, 48);
            let want = matched(&parameters, size, 1, Form::Plain);
            for form in forms() {
                for threads in [1, 3] {
                    let got = matched(&parameters, size, threads, form);
                    assert_eq!(bits(&got), bits(&want), "{preset} {size:?} {form:?} {threads}");
                }
            }
            for (d, c) in want.disparity.iter().zip(&want.confidence) {
                assert_eq!(d.is_nan(), *c == 0);
                assert!(d.is_nan() || (0.0..48.0).contains(d), "{d}");
            }
        }
    }
}

/// A wall with a box before it, of noise that differs by what a sensor adds; returns the pair and the disparity.
fn scene(w: usize, h: usize) -> ([Vec<u8>; 2], Vec<f32>) {
    let mut next = noise(99);
    let texture: Vec<u8> = (0..2 * w * h).map(|_| next()).collect();
    let inside = |x: usize, y: usize| (w / 3..w / 2).contains(&x) && (h / 4..3 * h / 4).contains(&y);
    let truth: Vec<f32> = (0..w * h).map(|i| if inside(i % w, i / w) { 30.0 } else { 10.0 }).collect();
    let mut right = vec![0; w * h];
    let mut left = vec![0; w * h];
    for y in 0..h {
        for near in [10, 30] {
            for x in (0..w).filter(|x| truth[y * w + x] == near as f32) {
                left[y * w + x] = texture[y * 2 * w + x + near].saturating_add(next() % 8);
                if x >= near {
                    right[y * w + x - near] = texture[y * 2 * w + x + near].saturating_add(next() % 8);
                }
            }
        }
    }
    ([left, right], truth)
}

#[test]
fn a_box_before_a_wall_is_found_and_what_it_hides_is_not() {
    let w = 180;
    let h = 80;
    let ([left, right], truth) = scene(w, h);
    let pair = StereoPair::new(Gray::packed(&left, w, h), Gray::packed(&right, w, h));
    for (preset, wrong_most, missing_most) in
        [(Preset::Performance, 0.06, 0.08), (Preset::Quality, 0.02, 0.03), (Preset::Ultra, 0.03, 0.03)]
    {
        let mut matcher = SgmMatcher::new(w, h, &Parameters::preset(preset, 48), 1).unwrap();
        let mut out = DisparityMap::default();
        matcher.run(&pair, &mut out).unwrap();
        // The part that the right camera sees too: not the first columns, and not the strip left of the box.
        let seen = |i: &usize| i % w >= 10 && !(w / 3 - 20..w / 3).contains(&(i % w));
        let all: Vec<usize> = (0..w * h).filter(seen).collect();
        let share = |f: &dyn Fn(&&usize) -> bool| all.iter().filter(f).count() as f64 / all.len() as f64;
        let missing = share(&|i| out.disparity[**i].is_nan());
        let wrong = share(&|i| (out.disparity[**i] - truth[**i]).abs() > 1.0);
        assert!(
            wrong <= wrong_most && missing <= missing_most,
            "{preset}: {wrong:.3} wrong, {missing:.3} missing"
        );
        let hidden = (h / 4..3 * h / 4).flat_map(|y| (w / 3 - 18..w / 3 - 2).map(move |x| y * w + x));
        let kept =
            hidden.clone().filter(|i| !out.disparity[*i].is_nan()).count() as f64 / hidden.count() as f64;
        // Half resolution sees less of it.
        let most = if preset == Preset::Quality { 0.3 } else { 0.6 };
        assert!(kept <= most, "{preset}: {kept:.2} of what is hidden has a disparity");
    }
}

#[test]
fn ultra_is_quality_with_what_half_resolution_adds() {
    let size = (150, 40);
    let [quality, half, ultra] = [Preset::Quality, Preset::Performance, Preset::Ultra]
        // Random images have no texture by the margins, and half resolution would add nothing.
        .map(|p| Parameters { texture_margin: 0, half_texture_margin: 0, ..Parameters::preset(p, 48) })
        .map(|p| matched(&p, size, 1, Form::best()));
    for i in 0..size.0 * size.1 {
        let want = if quality.disparity[i].is_nan() { half.disparity[i] } else { quality.disparity[i] };
        assert_eq!(ultra.disparity[i].to_bits(), want.to_bits());
    }
    assert!(ultra.fill() > quality.fill());
}

#[test]
fn presets_at_once_are_those_alone() {
    use Preset::{Performance, Quality, Ultra};
    let groups: [&[Preset]; 7] = [
        &[Performance],
        &[Quality],
        &[Ultra],
        &[Quality, Performance],
        &[Performance, Ultra],
        &[Ultra, Quality],
        &[Performance, Ultra, Quality],
    ];
    for (w, h) in [(1, 1), (37, 21), (150, 40)] {
        let pairs = [5, 6].map(|seed| pair(w, h, w, seed));
        let gray = |pixels| Gray::packed(pixels, w, h);
        for (presets, threads) in groups.into_iter().zip([1, 1, 3, 1, 3, 1, 3]) {
            let parameters: Vec<_> = presets.iter().map(|p| Parameters::preset(*p, 48)).collect();
            let mut at_once = SgmPresets::new(w, h, &parameters, threads).unwrap();
            let mut got = vec![DisparityMap::default(); presets.len()];
            let mut alone: Vec<_> = parameters.iter().map(|p| SgmMatcher::new(w, h, p, 1).unwrap()).collect();
            for [left, right] in &pairs {
                let pair = StereoPair::new(gray(left), gray(right));
                at_once.run(&pair, &mut got).unwrap();
                for ((preset, matcher), got) in presets.iter().zip(&mut alone).zip(&got) {
                    let mut want = DisparityMap::default();
                    matcher.run(&pair, &mut want).unwrap();
                    assert_eq!(bits(got), bits(&want), "{preset} of {presets:?}, {w}x{h}");
                }
            }
            for ((d, matcher), p) in at_once.describe().into_iter().zip(&alone).zip(&parameters) {
                let one = matcher.describe();
                assert_eq!((d.name, d.parameters), (one.name, p.describe()));
                assert!(d.memory_bytes >= one.memory_bytes);
            }
            assert!(at_once.run(&StereoPair::new(gray(&pairs[0][0]), gray(&pairs[0][1])), &mut []).is_err());
        }
    }
}

#[test]
fn presets_that_cannot_be_matched_at_once_are_refused() {
    let [a, b] = [Preset::Quality, Preset::Ultra].map(|p| Parameters::preset(p, 64));
    let other = Parameters { p1: b.p1 + 1, ..b.clone() };
    for (bad, says) in
        [(vec![], "no preset"), (vec![a.clone(), other], "different"), (vec![b.clone(), b], "same")]
    {
        let e = SgmPresets::new(64, 48, &bad, 1).unwrap_err();
        assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains(says), "{e}");
    }
    assert!(SgmPresets::new(0, 48, &[a], 1).is_err());
}

#[test]
fn memory_is_told_before_and_bounded() {
    let at = |width, disparities| {
        let parameters = Parameters::preset(Preset::Quality, disparities);
        SgmMatcher::with_form(width, 100, &parameters, 1, Form::Plain).unwrap().describe().memory_bytes
    };
    // A byte for each pixel and disparity, and at most 80 bytes a pixel besides.
    assert!((640 * 100 * 128..640 * 100 * (128 + 80)).contains(&at(640, 128)), "{}", at(640, 128));
    assert!(at(640, 128) - at(640, 64) >= 640 * 100 * 64);
}

#[test]
fn what_cannot_be_is_refused() {
    let good = Parameters::preset(Preset::Quality, 64);
    let refused = |w, h, change: fn(&mut Parameters)| {
        let mut parameters = good.clone();
        change(&mut parameters);
        SgmMatcher::new(w, h, &parameters, 1).unwrap_err().to_string()
    };
    assert!(refused(0, 5, |_| ()).contains("0x5"));
    assert!(refused(20_000, 5, |_| ()).contains("16384"));
    assert!(refused(9, 9, |p| p.max_disparity = 257).contains("257"));
    assert!(refused(9, 9, |p| p.max_disparity = 0).contains("1 to 256"));
    assert!(refused(9, 9, |p| p.p1 = 0).contains("p1 0"));
    assert!(refused(9, 9, |p| p.p2 = 64).contains("64"));
    assert!(refused(9, 9, |p| p.gap_step_px = f32::NAN).contains("gap_step_px"));
    let mut matcher = SgmMatcher::new(9, 9, &good, 1).unwrap();
    let pixels = [0; 90];
    let mut out = DisparityMap::default();
    let mut run =
        |left, right| matcher.run(&StereoPair::new(left, right), &mut out).map_err(|e| e.to_string());
    let whole = Gray::packed(&pixels, 9, 9);
    assert!(run(whole, Gray::packed(&pixels, 9, 10)).unwrap_err().contains("right"));
    assert!(run(Gray { stride: 8, ..whole }, whole).unwrap_err().contains("left"));
    assert!(run(Gray { pixels: &pixels[..80], ..whole }, whole).unwrap_err().contains("80 bytes"));
    assert!(run(Gray { stride: usize::MAX, ..whole }, whole).is_err());
    run(Gray { pixels: &pixels[..89], stride: 10, ..whole }, whole).unwrap();
}
