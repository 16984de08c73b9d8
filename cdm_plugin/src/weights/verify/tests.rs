//! Seeded weights that are changed in every way that a checkpoint can be wrong.

use super::*;
use crate::weights::write::{Planned, write};
use std::path::Path;

/// The tensors of vits with small made-up numbers, changed by `change`.
fn written(path: &Path, change: impl FnOnce(&mut Vec<Planned>), number: impl Fn(&str) -> f32) -> Weights {
    let tensors = Encoder::Vits.architecture().tensors().into_iter();
    let mut tensors: Vec<_> =
        tensors.map(|t| Planned { name: t.name, dtype: Dtype::Bf16, shape: t.shape }).collect();
    change(&mut tensors);
    crate::durable::create(path, |out| {
        write(out, &mut tensors, &BTreeMap::new(), &mut |t, out| {
            let len = t.shape.iter().product::<usize>() * t.dtype.bytes();
            let mut bytes = vec![0; len];
            let bits = half::bf16::from_f32(number(&t.name)).to_le_bytes();
            if let Some(last) = len.checked_sub(2) {
                bytes[last..].copy_from_slice(&bits);
            }
            out.write_all(&bytes)
        })
    })
    .unwrap();
    Weights::open(path).unwrap()
}

#[test]
fn everything_that_is_wrong_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cdm.safetensors");
    let change = |tensors: &mut Vec<Planned>| {
        tensors.retain(|t| t.name != "crossAtts.1.in_proj_bias" && t.name != "pretrained.norm.weight");
        for t in tensors.iter_mut().filter(|t| t.name == "depth_pretrained.cls_token") {
            t.shape = vec![1, 384];
        }
        let of = |name: &str| Planned { name: name.into(), dtype: Dtype::F32, shape: vec![2] };
        tensors.extend(["depth_head.extra", "readout.0"].map(of));
    };
    let number = |name: &str| match name {
        "pretrained.norm.bias" => f32::NAN,
        "depth_pretrained.norm.bias" => f32::NEG_INFINITY,
        _ => 1.0,
    };
    let w = written(&path, change, number);
    let report = examine(&w, None).unwrap();
    assert_eq!((report.encoder, report.good), (Encoder::Vits, 430 - 3));
    let names: Vec<_> = report.missing.iter().map(|m| (m.name.as_str(), m.shape.as_slice())).collect();
    assert_eq!(names, [("crossAtts.1.in_proj_bias", &[1152][..]), ("pretrained.norm.weight", &[384])]);
    let extra: Vec<_> = report.extra.iter().map(|e| format!("{}: {}", e.name, e.what)).collect();
    let what = "a tensor of F32, shape [2]";
    assert_eq!(extra, [format!("depth_head.extra: {what}"), format!("readout.0: {what}")]);
    let m = &report.misshaped[..];
    assert!(m.len() == 1 && m[0].name == "depth_pretrained.cls_token" && m[0].found == "[1, 384]", "{m:?}");
    let n: Vec<_> = report.not_finite.iter().map(|n| (n.name.as_str(), n.nan, n.infinite)).collect();
    assert_eq!(n, [("depth_pretrained.norm.bias", 0, 1), ("pretrained.norm.bias", 1, 0)]);
    let e = verify(&w).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadModel);
    for part in [
        "cdm.safetensors: not the weights of a camera depth model of encoder vits",
        "2 missing (crossAtts.1.in_proj_bias [1152], pretrained.norm.weight [384])",
        "1 of another shape or type (depth_pretrained.cls_token is [1, 384], must be [1, 1, 384])",
        "2 not of the network (depth_head.extra (a tensor of F32, shape [2]), readout.0",
        "2 with NaN or infinite numbers (depth_pretrained.norm.bias: 0 NaN, 1 infinite, pretrained.norm.bias: 1 NaN",
    ] {
        assert!(e.to_string().contains(part), "{part}\nnot in\n{e}");
    }
    // Without the numbers, the names alone.
    assert!(!verify_names(&w).unwrap_err().to_string().contains("NaN"));
}

#[test]
fn a_long_list_is_cut_in_the_message_alone() {
    let dir = tempfile::tempdir().unwrap();
    let w = written(&dir.path().join("a"), |t| t.retain(|t| !t.name.contains("blocks.7")), |_| 1.0);
    let report = examine(&w, None).unwrap();
    assert_eq!(report.missing.len(), 28);
    assert!(report.summary().contains(", and 20 more)"), "{}", report.summary());
}

#[test]
fn the_encoder_is_found_and_another_one_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let w = written(&dir.path().join("a"), |_| {}, |_| 1.0);
    assert_eq!(verify(&w).unwrap(), Encoder::Vits);
    assert!(examine(&w, Some(Encoder::Vits)).unwrap().is_good());
    let e = examine(&w, Some(Encoder::Vitl)).unwrap_err();
    assert!(e.to_string().contains("has the weights of the encoder vits, and vitl was asked for"), "{e}");
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/torch");
    let e = verify(&Weights::open(fixtures.join("plain.pth")).unwrap()).unwrap_err();
    assert!(
        e.to_string().contains("none of its 3 tensors is one of a camera depth model (it has head.bias"),
        "{e}"
    );
}

#[test]
fn all_kinds_of_floats_are_looked_at() {
    let f32s = [1.0_f32, f32::NAN, -f32::NAN, f32::INFINITY, f32::MAX, -0.0];
    let bytes: Vec<_> = f32s.iter().flat_map(|x| x.to_le_bytes()).collect();
    assert_eq!(not_finite(&bytes, Dtype::F32), (2, 1));
    let bytes: Vec<_> = f32s.iter().flat_map(|x| half::bf16::from_f32(*x).to_le_bytes()).collect();
    assert_eq!(not_finite(&bytes, Dtype::Bf16), (2, 2), "f32::MAX rounds to infinity");
    let bytes: Vec<_> = f32s.iter().flat_map(|x| half::f16::from_f32(*x).to_le_bytes()).collect();
    assert_eq!(not_finite(&bytes, Dtype::F16), (2, 2), "f32::MAX is too large");
}
