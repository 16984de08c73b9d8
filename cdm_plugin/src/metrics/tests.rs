//! Against values worked out by hand, and against a slow reading of the formulas.

use super::*;
use proptest::prelude::*;

fn near(a: f64, b: f64) -> bool {
    (a.is_nan() && b.is_nan()) || (a - b).abs() <= 1e-12 * (1.0 + a.abs().max(b.abs()))
}

const MM: f64 = 0.001;

#[test]
fn an_image_worked_out_by_hand() {
    // reference  1.0   2.0   4.0   1.0   hole  1.0   10.0 (out of range)
    // prediction 1.0   2.2   5.0   hole  1.0   1.2   10.0
    // error      0     0.2   1.0                0.2
    // factor     1     1.1   1.25               1.2
    let reference = [1000, 2000, 4000, 1000, 0, 1000, 10_000];
    let prediction = [1000, 2200, 5000, 0, 1000, 1200, 10_000];
    let m = compare(
        &Depth::Units { pixels: &prediction, unit_m: MM },
        &Depth::Units { pixels: &reference, unit_m: MM },
        DepthRange { min_m: 0.5, max_m: 5.0 },
    )
    .unwrap();
    assert_eq!((m.counted, m.valid, m.is_empty()), (5, 4, false));
    assert!(near(m.l1_m, 1.4 / 4.0), "{m:?}");
    assert!(near(m.rmse_m, (1.08f64 / 4.0).sqrt()), "{m:?}");
    assert!(near(m.abs_rel, (0.1 + 0.25 + 0.2) / 4.0), "{m:?}");
    assert!(near(m.delta_05, 2.0 / 4.0), "1 and 1.1 are below 1.118: {m:?}");
    assert!(near(m.delta_1, 3.0 / 4.0), "1.25 itself is not below 1.25: {m:?}");
    assert!(near(m.strict_delta_05, 2.0 / 5.0) && near(m.strict_delta_1, 3.0 / 5.0), "{m:?}");
    assert!(near(m.missing_percent, 20.0), "{m:?}");
    // The hole is off by its 1 m.
    assert!(near(m.strict_l1_m, 2.4 / 5.0) && near(m.strict_rmse_m, (2.08f64 / 5.0).sqrt()), "{m:?}");
    assert!(near(m.strict_abs_rel, 1.55 / 5.0), "{m:?}");
}

#[test]
fn too_near_and_too_far_by_one_factor_are_alike() {
    // 1.25 is exact in binary: the comparison is met exactly, and it is strict.
    for (p, within) in [(1.25f32, 0.0), (1.249, 1.0), (0.801, 1.0), (0.799, 0.0)] {
        let m = compare(&Depth::Metres(&[p]), &Depth::Metres(&[1.0]), DepthRange::ALL).unwrap();
        assert_eq!(m.delta_1, within, "{p}");
    }
    let m = compare(&Depth::Metres(&[1.0]), &Depth::Metres(&[1.25]), DepthRange::ALL).unwrap();
    assert_eq!(m.delta_1, 0.0);
    let m = compare(&Depth::Metres(&[1.118, 1.1181]), &Depth::Metres(&[1.0, 1.0]), DepthRange::ALL).unwrap();
    assert_eq!(m.delta_05, 0.5, "the threshold lies at 1.118034");
}

#[test]
fn the_range_includes_its_ends() {
    let d = [1.0f32, 2.0, 3.0];
    let m = compare(&Depth::Metres(&d), &Depth::Metres(&d), DepthRange { min_m: 1.0, max_m: 2.0 }).unwrap();
    assert_eq!(m.counted, 2);
}

#[test]
fn nothing_to_compare_is_not_perfect() {
    let nan_everywhere = |m: &DepthMetrics| {
        [m.l1_m, m.rmse_m, m.abs_rel, m.delta_05, m.delta_1].iter().all(|v| v.is_nan()) && m.is_empty()
    };
    let m = compare(&Depth::Metres(&[]), &Depth::Metres(&[]), DepthRange::ALL).unwrap();
    assert!(nan_everywhere(&m) && m.strict_delta_1.is_nan() && m.missing_percent.is_nan(), "{m:?}");
    // A prediction that is all holes fails everywhere, and says so.
    let m = compare(&Depth::Metres(&[f32::NAN, 0.0]), &Depth::Metres(&[1.0, 2.0]), DepthRange::ALL).unwrap();
    assert!(nan_everywhere(&m), "{m:?}");
    assert_eq!((m.strict_delta_05, m.strict_delta_1, m.missing_percent), (0.0, 0.0, 100.0));
}

#[test]
fn holes_of_every_kind() {
    let d = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.0, -0.0, -1.0, 1.0, f32::MIN_POSITIVE];
    assert_eq!(fill_rate(&Depth::Metres(&d)), 2.0 / 8.0);
    assert_eq!(fill_rate(&Depth::Units { pixels: &[0, 1, 65535, 0], unit_m: MM }), 0.5);
    assert!(fill_rate(&Depth::Metres(&[])).is_nan());
    let m = compare(&Depth::Metres(&[1.0; 8]), &Depth::Metres(&d), DepthRange::ALL).unwrap();
    assert_eq!((m.counted, m.valid), (2, 2));
}

#[test]
fn what_is_refused() {
    let error = compare(&Depth::Metres(&[1.0]), &Depth::Metres(&[1.0, 2.0]), DepthRange::ALL).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::SizeMismatch);
    assert!(error.to_string().contains("1 pixels") && error.to_string().contains("reference 2"), "{error}");
    for unit_m in [0.0, -0.001, f64::NAN, f64::INFINITY] {
        let bad = Depth::Units { pixels: &[1], unit_m };
        let error = compare(&bad, &Depth::Metres(&[1.0]), DepthRange::ALL).unwrap_err();
        assert!(error.kind() == ErrorKind::BadInput && error.to_string().contains("prediction"), "{error}");
    }
    for (min_m, max_m) in [(2.0, 1.0), (f64::NAN, 1.0), (0.0, f64::NAN)] {
        let range = DepthRange { min_m, max_m };
        let error = compare(&Depth::Metres(&[1.0]), &Depth::Metres(&[1.0]), range).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::BadInput);
    }
}

#[test]
fn the_two_means_of_a_dataset_differ() {
    let mut set = Dataset::new(DepthRange::ALL);
    let one = [1.0f32; 4];
    // Four pixels off by 0.1, then one pixel off by 0.3 beside three holes; then an image of holes only.
    set.add(&Depth::Metres(&[1.1; 4]), &Depth::Metres(&one)).unwrap();
    set.add(&Depth::Metres(&[1.3, 0.0, 0.0, 0.0]), &Depth::Metres(&one)).unwrap();
    set.add(&Depth::Metres(&[0.0; 4]), &Depth::Metres(&one)).unwrap();
    set.add(&Depth::Metres(&one), &Depth::Metres(&[0.0; 4])).unwrap();
    assert!(set.add(&Depth::Metres(&one), &Depth::Metres(&[])).is_err());
    let m = set.metrics();
    assert_eq!((m.images, m.empty_images), (4, 2));
    let close = |a: f64, b: f64| (a - b).abs() < 1e-6; // 1.1 and 1.3 are f32
    assert!(close(m.mean_of_images.l1_m, 0.2) && close(m.pixel_pooled.l1_m, 0.7 / 5.0), "{m:?}");
    assert!(close(m.mean_of_images.rmse_m, 0.2), "{m:?}");
    assert!(close(m.pixel_pooled.rmse_m, ((4.0 * 0.01 + 0.09) / 5.0f64).sqrt()), "{m:?}");
    assert!(close(m.mean_of_images.missing_percent, 175.0 / 3.0), "{m:?}");
    assert!(close(m.pixel_pooled.missing_percent, 700.0 / 12.0), "{m:?}");
    assert!(close(m.mean_of_images.delta_1, 0.5) && close(m.pixel_pooled.delta_1, 0.8), "{m:?}");
    assert!(close(m.mean_of_images.strict_delta_1, 1.0 / 3.0), "{m:?}");
    assert!(Dataset::new(DepthRange::ALL).metrics().mean_of_images.l1_m.is_nan());
}

/// The formulas one by one over lists, as they stand in the documentation.
fn slow(prediction: &[f32], reference: &[f32], range: DepthRange) -> DepthMetrics {
    let counts =
        |d: f32| d.is_finite() && d > 0.0 && f64::from(d) >= range.min_m && f64::from(d) <= range.max_m;
    let counted: Vec<_> = prediction.iter().zip(reference).filter(|(_, r)| counts(**r)).collect();
    let valid: Vec<(f64, f64)> = counted
        .iter()
        .filter(|(p, _)| p.is_finite() && **p > 0.0)
        .map(|(p, r)| (f64::from(**p), f64::from(**r)))
        .collect();
    let n = valid.len() as f64;
    let mean = |f: &dyn Fn(f64, f64) -> f64| valid.iter().map(|(d, t)| f(*d, *t)).sum::<f64>() / n;
    let within = |f: f64| valid.iter().filter(|(d, r)| (d / r).max(r / d) < f).count() as f64;
    let hits = |t: f64| within(1.25f64.powf(t));
    let all = counted.len() as f64;
    // Strict: a missing pixel is a prediction of 0.
    let or_zero = |p: f32| if p.is_finite() && p > 0.0 { f64::from(p) } else { 0.0 };
    let all_errors: Vec<(f64, f64)> =
        counted.iter().map(|(p, r)| ((or_zero(**p) - f64::from(**r)).abs(), f64::from(**r))).collect();
    DepthMetrics {
        counted: counted.len() as u64,
        valid: valid.len() as u64,
        l1_m: mean(&|d, t| (d - t).abs()),
        rmse_m: mean(&|d, t| (d - t).powi(2)).sqrt(),
        abs_rel: mean(&|d, t| (d - t).abs() / t),
        delta_05: hits(0.5) / n,
        delta_1: hits(1.0) / n,
        delta_105: within(1.05) / n,
        delta_110: within(1.1) / n,
        strict_l1_m: all_errors.iter().map(|(e, _)| e).sum::<f64>() / all,
        strict_rmse_m: (all_errors.iter().map(|(e, _)| e * e).sum::<f64>() / all).sqrt(),
        strict_abs_rel: all_errors.iter().map(|(e, t)| e / t).sum::<f64>() / all,
        strict_delta_05: hits(0.5) / all,
        strict_delta_1: hits(1.0) / all,
        strict_delta_105: within(1.05) / all,
        strict_delta_110: within(1.1) / all,
        missing_percent: 100.0 * (all - n) / all,
    }
}

fn values(m: &DepthMetrics) -> Vec<f64> {
    let plain = [m.l1_m, m.rmse_m, m.abs_rel, m.delta_05, m.delta_1, m.delta_105, m.delta_110];
    let strict = [m.strict_l1_m, m.strict_rmse_m, m.strict_abs_rel];
    let shares = [m.strict_delta_05, m.strict_delta_1, m.strict_delta_105, m.strict_delta_110];
    let counts = [m.counted as f64, m.valid as f64, m.missing_percent];
    counts.into_iter().chain(plain).chain(strict).chain(shares).collect()
}

/// Depth that is mostly ordinary and now and then a hole of some kind.
fn depth() -> impl Strategy<Value = f32> {
    prop_oneof![6 => 0.2f32..8.0, 1 => Just(0.0), 1 => Just(f32::NAN), 1 => Just(-1.0), 1 => Just(f32::INFINITY)]
}

proptest! {
    #[test]
    fn equals_the_slow_reading(
        pairs in prop::collection::vec((depth(), depth(), 0.85f32..1.3), 0..200),
        min_m in 0.0..2.0,
        size in 0.0..6.0,
    ) {
        let reference: Vec<f32> = pairs.iter().map(|p| p.1).collect();
        // Half of the predictions are near the truth, or the thresholds would hardly be met.
        let prediction: Vec<f32> =
            pairs.iter().enumerate().map(|(i, p)| if i % 2 == 0 { p.0 } else { p.1 * p.2 }).collect();
        let range = DepthRange { min_m, max_m: min_m + size };
        let fast = compare(&Depth::Metres(&prediction), &Depth::Metres(&reference), range).unwrap();
        let slow = slow(&prediction, &reference, range);
        for (a, b) in values(&fast).into_iter().zip(values(&slow)) {
            prop_assert!(near(a, b), "{:?}\n{:?}", fast, slow);
        }
        // By distance: each bin is the measure of a range, and all of them together are the whole.
        let p = Depth::Metres(&prediction);
        let r = Depth::Metres(&reference);
        let rules = Rules { range, bin_m: 0.5, bins: 9, skip_not_finite: false };
        let materials: Vec<u8> = (0..reference.len()).map(|i| (i % 3) as u8).collect();
        let measured = Measured::of(&p, &r, Some(&materials), &rules).unwrap();
        let bits = |m: &DepthMetrics| values(m).into_iter().map(f64::to_bits).collect::<Vec<_>>();
        prop_assert_eq!(bits(&measured.metrics()), bits(&fast));
        // A file has the same bits.
        let text = serde_json::to_string(&measured).unwrap();
        prop_assert_eq!(&serde_json::from_str::<Measured>(&text).unwrap(), &measured);
        // Each material is the measure of its pixels alone.
        for (number, of) in measured.by_material() {
            let only: Vec<f32> =
                reference.iter().zip(&materials).map(|(t, m)| if *m == number { *t } else { 0.0 }).collect();
            let wanted = compare(&p, &Depth::Metres(&only), range).unwrap();
            prop_assert_eq!(bits(&of), bits(&wanted));
        }
        // Left out, NaN is neither right nor wrong.
        let skipping = Measured::of(&p, &r, None, &Rules { skip_not_finite: true, ..rules }).unwrap();
        let finite: Vec<f32> =
            reference.iter().zip(&prediction).map(|(t, p)| if p.is_finite() { *t } else { 0.0 }).collect();
        let wanted = compare(&p, &Depth::Metres(&finite), range).unwrap();
        prop_assert_eq!(bits(&skipping.metrics()), bits(&wanted));
        prop_assert_eq!(skipping.not_finite(), fast.counted - wanted.counted);
        let bins = measured.by_distance(&rules);
        prop_assert_eq!(bins.iter().map(|b| b.metrics.counted).sum::<u64>(), fast.counted);
        for bin in &bins {
            // The end of a bin belongs to the next one; the last one has none.
            let below = if bin.to_m < 4.5 { f64::from_bits(bin.to_m.to_bits() - 1) } else { f64::INFINITY };
            let min_m = bin.from_m.max(range.min_m);
            let max_m = below.min(range.max_m);
            let wanted = if min_m > max_m { 0 } else {
                compare(&p, &r, DepthRange { min_m, max_m }).unwrap().counted
            };
            prop_assert!(bin.metrics.counted == wanted, "{:?}: {}", bin, wanted);
        }
        let errors = measured.errors();
        prop_assert_eq!(errors.counts.iter().sum::<u64>(), fast.valid);
        prop_assert_eq!(errors.missing, fast.counted - fast.valid);
        prop_assert_eq!(measured.fill_rate().to_bits(), fill_rate(&p).to_bits());
    }

    #[test]
    fn units_and_metres_agree(pixels in prop::collection::vec((0u16..4000, 0u16..4000), 1..100)) {
        // 1/1024 m is exact in binary: both readings see the same depths.
        let unit_m = 1.0 / 1024.0;
        let (p, r): (Vec<u16>, Vec<u16>) = pixels.into_iter().unzip();
        let metres = |v: &[u16]| v.iter().map(|d| f32::from(*d) / 1024.0).collect::<Vec<_>>();
        let pm = metres(&p);
        let rm = metres(&r);
        let p = Depth::Units { pixels: &p, unit_m };
        let r = Depth::Units { pixels: &r, unit_m };
        let a = compare(&p, &r, DepthRange::ALL).unwrap();
        let b = compare(&Depth::Metres(&pm), &Depth::Metres(&rm), DepthRange::ALL).unwrap();
        for (a, b) in values(&a).into_iter().zip(values(&b)) {
            prop_assert!(near(a, b));
        }
        prop_assert_eq!(fill_rate(&p), fill_rate(&Depth::Metres(&pm)));
    }
}
