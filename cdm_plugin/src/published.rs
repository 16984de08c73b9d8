//! The published models: their names here, where they lie, and which camera each is for.
//!
//! Repositories, file names, licences and the one hash are those of the pages of `huggingface.co/depth-anything` as they
//! were read in stored copies; none of the files was ever fetched by the people who wrote this.

/// A published checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Published {
    /// Name in depthrig.
    pub name: &'static str,
    /// Owner and name of its repository.
    pub repository: &'static str,
    /// Its file there.
    pub file: &'static str,
    /// SHA-256 of the file, in hexadecimal, where it is known.
    pub sha256: Option<&'static str>,
    /// Its licence, according to its page.
    pub licence: &'static str,
    /// Whether repository and file were seen on a page; else they are formed like the others.
    pub seen: bool,
    /// The cameras that it is for; [`serves`] says when a camera is one of them.
    pub cameras: &'static [&'static str],
}

const NON_COMMERCIAL: &str = "CC-BY-NC-4.0";

/// Every published checkpoint; all of them are of the encoder vitl. Where two serve a camera, the first is taken.
pub const PUBLISHED: [Published; 7] = [
    Published {
        name: "cdm-d435",
        repository: "depth-anything/camera-depth-model-d435",
        file: "cdm_d435.ckpt",
        sha256: None,
        licence: NON_COMMERCIAL,
        seen: true,
        cameras: &["D415", "D435", "D455"],
    },
    Published {
        name: "cdm-d405",
        repository: "depth-anything/camera-depth-model-d405",
        file: "cdm_d405.ckpt",
        sha256: None,
        licence: NON_COMMERCIAL,
        seen: true,
        cameras: &["D405"],
    },
    Published {
        name: "cdm-l515",
        repository: "depth-anything/camera-depth-model-l515",
        file: "cdm_l515.ckpt",
        sha256: None,
        licence: NON_COMMERCIAL,
        seen: true,
        cameras: &["L515"],
    },
    Published {
        name: "cdm-kinect",
        repository: "depth-anything/camera-depth-model-kinect",
        file: "cdm_kinect.ckpt",
        sha256: Some("ba2b8899a683876f9d935723c3a9e8684903b94622264aa74e73b439faae488a"),
        licence: NON_COMMERCIAL,
        seen: true,
        cameras: &["Azure Kinect"],
    },
    Published {
        name: "cdm-zed2i-neural",
        repository: "depth-anything/camera-depth-model-zed2i-neural",
        file: "cdm_zed2i_neural.ckpt",
        sha256: None,
        licence: "Apache-2.0",
        seen: true,
        cameras: &["ZED 2i"],
    },
    Published {
        name: "cdm-zed2i-quality",
        repository: "depth-anything/camera-depth-model-zed2i-quality",
        file: "cdm_zed2i_quality.ckpt",
        sha256: None,
        licence: "the one on its page",
        seen: false,
        cameras: &["ZED 2i"],
    },
    Published {
        name: "cdm-base",
        repository: "depth-anything/camera-depth-model-base",
        file: "cdm_base.pth",
        sha256: None,
        licence: NON_COMMERCIAL,
        seen: true,
        cameras: &[],
    },
];

/// The published checkpoint of this name.
pub fn published(name: &str) -> Option<&'static Published> {
    PUBLISHED.iter().find(|p| p.name == name)
}

/// The published checkpoint for a camera, by its model: `Intel RealSense D435I`, `ZED 2i`, `Azure Kinect`. A rig's
/// configuration overrides this.
pub fn for_camera(model: &str) -> Option<&'static Published> {
    PUBLISHED.iter().find(|p| p.cameras.iter().any(|camera| serves(camera, model)))
}

/// Whether `camera`, an entry of such a table, is the model of camera `model`: the words of it are in the name, upper or
/// lower case, with or without spaces; letters after it (`D435` and `D435I`) make no difference.
pub fn serves(camera: &str, model: &str) -> bool {
    let plain = |text: &str| -> String {
        text.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
    };
    let camera = plain(camera);
    let model = plain(model);
    !camera.is_empty() && model.contains(&camera)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_find_their_model() {
        for (camera, name) in [
            ("Intel RealSense D435I", Some("cdm-d435")),
            ("D415", Some("cdm-d435")),
            ("Intel RealSense D455f", Some("cdm-d435")),
            ("RealSense D405", Some("cdm-d405")),
            ("Intel RealSense L515", Some("cdm-l515")),
            ("Azure Kinect", Some("cdm-kinect")),
            ("ZED 2i", Some("cdm-zed2i-neural")),
            ("ZED2i", Some("cdm-zed2i-neural")),
            ("ZED 2", None),
            ("Integrated Webcam", None),
            ("", None),
        ] {
            assert_eq!(for_camera(camera).map(|p| p.name), name, "{camera}");
        }
        assert!(!serves("", "D435"));
    }

    #[test]
    fn the_table_is_sound() {
        for p in PUBLISHED {
            assert!(crate::store::check_name(p.name).is_ok(), "{}", p.name);
            assert_eq!(published(p.name).map(|q| q.file), Some(p.file), "names are different");
            assert!(p.sha256.is_none_or(|h| h.len() == 64 && h.bytes().all(|b| b.is_ascii_hexdigit())));
        }
    }
}
