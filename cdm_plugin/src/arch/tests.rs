//! The tables against the names and shapes of the official checkpoints.

use super::*;
use std::path::{Path, PathBuf};

/// The folder of the parity data; it is not in the repository.
fn keys() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let root =
        std::env::var_os("DEPTHRIG_TEST_DATA").filter(|v| !v.is_empty()).map_or_else(default, PathBuf::from);
    root.join("cdm_parity/keys")
}

#[test]
fn every_tensor_of_the_official_checkpoints() {
    for encoder in Encoder::ALL {
        let path = keys().join(format!("{encoder}_keys.txt"));
        let text = std::fs::read_to_string(&path).unwrap_or_else(|e| {
            panic!("{}: {e}; set DEPTHRIG_TEST_DATA to a folder that holds cdm_parity", path.display())
        });
        let ours: Vec<String> =
            encoder.architecture().tensors().iter().map(|t| format!("{}\t{:?}", t.name, t.shape)).collect();
        let theirs: Vec<&str> = text.lines().collect();
        assert_eq!(ours, theirs, "{encoder}");
    }
}

#[test]
fn what_has_no_effect_is_marked() {
    for encoder in Encoder::ALL {
        let unused: Vec<_> =
            encoder.architecture().tensors().into_iter().filter(|t| !t.used).map(|t| t.name).collect();
        let unit = |n: &str| format!("depth_head_rgbd.scratch.refinenet4.resConfUnit1.{n}");
        let expected = [
            "pretrained.mask_token".to_owned(),
            "depth_pretrained.mask_token".to_owned(),
            unit("conv1.weight"),
            unit("conv1.bias"),
            unit("conv2.weight"),
            unit("conv2.bias"),
        ];
        assert_eq!(unused, expected, "{encoder}");
    }
}

#[test]
fn heads_are_64_wide_and_the_last_block_is_tapped() {
    for encoder in Encoder::ALL {
        let a = encoder.architecture();
        assert_eq!(a.head_width(), 64, "{encoder}");
        assert_eq!(a.taps[3], a.blocks - 1, "{encoder}");
        assert_eq!(a.width % FUSION_HEADS, 0, "{encoder}");
        assert_eq!(encoder.name().parse::<Encoder>().unwrap(), encoder);
    }
    let error = "vitx".parse::<Encoder>().unwrap_err();
    assert!(error.to_string().contains("\"vitx\"") && error.to_string().contains("vitl"), "{error}");
}
