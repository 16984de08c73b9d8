//! Rejecting pixels without texture costs a textured scene next to nothing: on a real pair, in every preset.
//!
//! Missing real images make it fail: `DEPTHRIG_TEST_DATA` names the folder that holds them.
#![allow(missing_docs, clippy::unwrap_used)]

use depthrig_calib::stereo::{DisparityMap, Matcher, Parameters, Preset, SgmMatcher};
use depthrig_tests::pairs::Pair;

#[test]
fn a_textured_scene_keeps_its_coverage() {
    let aloe = Pair::aloe(1);
    let (w, h) = aloe.size;
    let filled = |parameters: &Parameters| {
        let mut out = DisparityMap::default();
        SgmMatcher::new(w, h, parameters, 1).unwrap().run(&aloe.pair(), &mut out).unwrap();
        100.0 * out.fill()
    };
    for preset in Preset::ALL {
        let refusing = Parameters::preset(preset, 224);
        let mut all = refusing.clone();
        all.texture_margin = 0;
        all.half_texture_margin = 0;
        let [before, after] = [&all, &refusing].map(filled);
        assert!(after < before && after > before - 1.0, "{preset}: {before:.2} % before, {after:.2} % after");
    }
}
