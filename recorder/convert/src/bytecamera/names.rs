//! Names of cameras and files in the layout.

use depthrig_bus::Name;

/// Longest name of a camera or stream, bytes.
const NAME_MAX_BYTES: usize = 31;
/// Camera models that have two spellings: the short one, the long one, and the name of the model.
const MODELS: [(&str, &str, &str); 8] = [
    ("d405", "realsense_405", "D405"),
    ("d415", "realsense_415", "D415"),
    ("d435", "realsense_435", "D435"),
    ("d435i", "realsense_435i", "D435i"),
    ("d455", "realsense_455", "D455"),
    ("l515", "realsense_515", "L515"),
    ("zed2i", "zed2i", "ZED 2i"),
    ("kinect", "kinect", "Azure Kinect"),
];

/// Metres per unit of depth as the cameras come, for recordings that do not say it: Intel's defaults for the D400 and
/// L500 series, and millimetres for what the ZED and Kinect recorders write. A D405 counts in 0.1 mm.
pub(super) fn usual_depth_unit_m(model: &str) -> Option<f64> {
    let short = known(model)?.0;
    Some(match short {
        "d405" => 0.0001,
        "l515" => 0.000_25,
        _ => 0.001,
    })
}

/// The model that a name or a description means, if it is one of the known ones.
fn known(text: &str) -> Option<&'static (&'static str, &'static str, &'static str)> {
    let plain: String = text.to_lowercase().chars().filter(char::is_ascii_alphanumeric).collect();
    let has = |word: &str| plain.contains(word);
    let digits = |number: &str, letter: &str| {
        has(&format!("{letter}{number}")) || (has("realsense") && plain.contains(number))
    };
    let short = if digits("435i", "d") {
        "d435i"
    } else if let Some(n) = ["405", "415", "435", "455"].into_iter().find(|n| digits(n, "d")) {
        MODELS.iter().map(|m| m.0).find(|short| *short == format!("d{n}"))?
    } else if digits("515", "l") {
        "l515"
    } else if has("zed2i") || plain == "zed" {
        "zed2i"
    } else if has("kinect") || has("k4a") {
        "kinect"
    } else {
        return None;
    };
    MODELS.iter().find(|m| m.0 == short)
}

/// The part of a folder's name behind `camera_` for a camera of this model.
pub(super) fn of_model(model: &str, camera: &str, long: bool) -> String {
    match known(model) {
        Some(m) if long => m.1.to_owned(),
        Some(m) => m.0.to_owned(),
        None => camera.to_owned(),
    }
}

/// Depth modes of stereo cameras that have a folder of their own.
const DEPTH_MODES: [&str; 6] = ["performance", "quality", "ultra", "neural", "neural_light", "neural_plus"];

/// The depth mode that a stream is of, such as `quality` for `depth_quality`.
pub(super) fn mode_of(stream: &str) -> Option<&str> {
    let kinds = ["depth_", "confidence_", "disparity_"];
    let mode = kinds.iter().find_map(|kind| stream.strip_prefix(kind))?;
    DEPTH_MODES.contains(&mode).then_some(mode)
}

/// Camera name and model for the folder `camera_<part>`; a depth mode such as `zed2i_quality` stays in both.
pub(super) fn camera_of(part: &str) -> (Name, String) {
    let lower = part.to_lowercase();
    let mut named = lower.clone();
    let mut model = part.to_owned();
    // The longest spelling first: realsense_435i is not a realsense_435.
    let mut spellings: Vec<_> = MODELS.iter().flat_map(|m| [(m.0, m), (m.1, m)]).collect();
    spellings.push(("realsense_l515", &MODELS[5]));
    spellings.sort_by_key(|(s, _)| std::cmp::Reverse(s.len()));
    for (spelling, m) in spellings {
        let Some(rest) = lower.strip_prefix(spelling) else { continue };
        if rest.is_empty() || rest.starts_with('_') {
            named = format!("{}{rest}", m.0);
            let mode = rest.trim_start_matches('_').replace('_', " ");
            model = if mode.is_empty() { m.2.to_owned() } else { format!("{} ({mode})", m.2) };
            break;
        }
    }
    (name(&named), model)
}

/// The nearest thing to `text` that is a name.
pub(super) fn name(text: &str) -> Name {
    let clean = |c: char| if c.is_ascii_lowercase() || c.is_ascii_digit() { c } else { '_' };
    let mut plain: String = text.to_lowercase().chars().map(clean).collect();
    if !plain.starts_with(|c: char| c.is_ascii_lowercase()) {
        plain.insert(0, 'c');
    }
    plain.truncate(NAME_MAX_BYTES);
    // Made of the letters that a name may have; the fallback is never needed.
    Name::new(plain).or_else(|_| Name::new("camera")).unwrap_or_else(|_| unreachable!())
}

/// `plain`, or where that is taken, `plain` with the first number from `n` on that makes a free name of it. It
/// is cut so that the number fits.
pub(super) fn free(plain: &Name, mut n: u32, taken: impl Fn(&str) -> bool) -> Name {
    let mut found = plain.clone();
    while taken(found.as_str()) {
        let number = format!("_{n}");
        let stem = plain.as_str().get(..NAME_MAX_BYTES - number.len()).unwrap_or(plain.as_str());
        found = name(&format!("{stem}{number}"));
        n = n.wrapping_add(1);
    }
    found
}

/// The parts of a file's name: `raw_depth_12.npy` is `raw_depth`, 12, `npy`.
pub(super) fn file_parts(name: &str) -> Option<(&str, u32, &str)> {
    let (stem, ending) = name.rsplit_once('.')?;
    let (prefix, digits) = stem.rsplit_once('_')?;
    let plain = !prefix.is_empty() && !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
    plain.then(|| Some((prefix, digits.parse().ok()?, ending))).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_spellings_are_one_camera() {
        for (part, camera, model) in [
            ("d455", "d455", "D455"),
            ("realsense_455", "d455", "D455"),
            ("realsense_l515", "l515", "L515"),
            ("realsense_435i", "d435i", "D435i"),
            ("zed2i_quality", "zed2i_quality", "ZED 2i (quality)"),
            ("d435_2", "d435_2", "D435 (2)"),
            ("Mech-Mind 7", "mech_mind_7", "Mech-Mind 7"),
            ("7up", "c7up", "7up"),
        ] {
            let (name, found_model) = camera_of(part);
            assert_eq!((name.as_str(), found_model.as_str()), (camera, model));
        }
    }

    #[test]
    fn models_have_their_spellings() {
        for (model, short, long) in [
            ("Intel RealSense D455", "d455", "realsense_455"),
            ("D435I", "d435i", "realsense_435i"),
            ("L515", "l515", "realsense_515"),
            ("ZED 2i (neural)", "zed2i", "zed2i"),
            ("Azure Kinect", "kinect", "kinect"),
            ("Test 1", "front", "front"),
        ] {
            assert_eq!(of_model(model, "front", false), short);
            assert_eq!(of_model(model, "front", true), long);
        }
        assert_eq!(usual_depth_unit_m("D405"), Some(0.0001));
        assert_eq!(usual_depth_unit_m("Intel RealSense L515"), Some(0.000_25));
        assert_eq!(usual_depth_unit_m("Test 1"), None);
    }

    #[test]
    fn depth_modes_are_known_by_their_streams() {
        assert_eq!(mode_of("depth_quality"), Some("quality"));
        assert_eq!(mode_of("confidence_neural"), Some("neural"));
        for other in ["depth", "depth_refined", "color", "color_quality", "depth_"] {
            assert_eq!(mode_of(other), None, "{other}");
        }
    }

    #[test]
    fn a_number_makes_a_name_free_however_long_it_is() {
        let found = |plain: &str, n: u32, taken: &[&str]| {
            free(&name(plain), n, |name| taken.contains(&name)).to_string()
        };
        assert_eq!(found("d455", 2, &["d435"]), "d455");
        assert_eq!(found("d455", 2, &["d455", "d455_2"]), "d455_3");
        let long = "a".repeat(31);
        let stem = "a".repeat(29);
        assert_eq!(found(&long, 2, &[&long]), format!("{stem}_2"));
        assert_eq!(found(&long, 2, &[&long, &format!("{stem}_2")]), format!("{stem}_3"));
        let last = format!("{}_4294967295", "a".repeat(20));
        assert_eq!(found(&long, u32::MAX, &[&long, &last]), format!("{stem}_0"));
    }

    #[test]
    fn file_names_are_read() {
        assert_eq!(file_parts("raw_depth_12.npy"), Some(("raw_depth", 12, "npy")));
        assert_eq!(file_parts("depth_007.png"), Some(("depth", 7, "png")));
        for none in ["depth.png", "_1.png", "depth_.png", "depth_1", "depth_-1.png", "depth_99999999999.png"]
        {
            assert_eq!(file_parts(none), None, "{none}");
        }
    }
}
