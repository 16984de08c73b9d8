//! Damaged images end with an error or with pixels, never with a panic or without end.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_jpeg::{Form, Info, decode, decode_into};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use proptest::prelude::*;

fn jpeg(progressive: bool) -> Vec<u8> {
    let pixels: Vec<u8> = (0..48 * 40 * 3).map(|i| (i * 7 + i / 13) as u8).collect();
    let mut out = Vec::new();
    let mut encoder = Encoder::new(&mut out, 80);
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    encoder.set_progressive(progressive);
    encoder.encode(&pixels, 48, 40, ColorType::Rgb).unwrap();
    out
}

/// A decoder that fills what is missing with grey shows a camera's cut frame as a good one.
#[test]
fn a_cut_image_is_an_error_at_any_length() {
    for progressive in [false, true] {
        let whole = jpeg(progressive);
        assert!(decode(&whole).is_ok());
        let scan = whole.windows(2).position(|mark| mark == [0xFF, 0xDA]).unwrap();
        for keep in (0..whole.len() - 2).filter(|n| !progressive || *n < scan) {
            assert!(decode(&whole[..keep]).is_err(), "{keep} of {} bytes", whole.len());
        }
    }
}

#[test]
fn another_size_and_another_form_are_refused() {
    let whole = jpeg(false);
    let right = Info { width: 48, height: 40, form: Form::Rgb };
    let mut out = vec![0; right.bytes()];
    decode_into(&whole, right, &mut out).unwrap();
    for wrong in
        [Info { width: 47, ..right }, Info { height: 41, ..right }, Info { form: Form::Grey, ..right }]
    {
        let e = decode_into(&whole, wrong, &mut out).unwrap_err().to_string();
        assert!(e.contains("48x40 colour") && e.contains(&wrong.to_string()), "{e}");
    }
    let short = out.len() - 1;
    assert!(decode_into(&whole, right, &mut out[..short]).is_err());
}

/// A file of a few bytes per scan would otherwise cost the time of a whole image each.
#[test]
fn an_image_of_very_many_scans_is_refused() {
    let whole = jpeg(true);
    let scan = whole.windows(2).position(|mark| mark == [0xFF, 0xDA]).unwrap();
    let next =
        scan + 2 + whole[scan + 2..].windows(2).position(|mark| mark[0] == 0xFF && mark[1] != 0).unwrap();
    let again = whole[scan..next].repeat(1000);
    let bomb = [&whole[..scan], &again, &whole[scan..]].concat();
    let e = decode(&bomb).unwrap_err().to_string();
    assert!(e.contains("scan count"), "{e}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]
    #[test]
    fn damage_is_an_error_or_an_image(
        progressive: bool,
        hits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        cut in any::<prop::sample::Index>(),
        is_cut: bool,
    ) {
        let mut bytes = jpeg(progressive);
        for (at, value) in hits {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if is_cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        if let Ok(image) = decode(&bytes) {
            prop_assert_eq!(image.pixels.len(), image.info.bytes());
        }
    }
}
