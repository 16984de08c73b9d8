//! The files backend keeps every promise of the suite that a folder of images can be held to.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::HostTime;
use depthrig_sim::conformance::{self, Bench, Cannot, Rig, Sent, Subject, Trouble};
use depthrig_sim::files::{FilesBackend, FilesConfig};
use image::{ImageBuffer, Luma, Rgb};
use tempfile::TempDir;

const SIZE: (u32, u32) = (16, 12);
const IMAGES: u32 = 5;
const MANIFEST: &str = r#"
model = "Folder"
serial = "bench"
rate_hz = 100.0
[[stream]]
name = "color"
files = "color_*.png"
[[stream]]
name = "depth"
files = "depth_*.png"
depth_unit_m = 0.001
"#;

fn color(n: u32) -> ImageBuffer<Rgb<u8>, Vec<u8>> {
    ImageBuffer::from_fn(SIZE.0, SIZE.1, |x, y| Rgb([x as u8, y as u8, n as u8]))
}

fn depth(n: u32) -> ImageBuffer<Luma<u16>, Vec<u16>> {
    ImageBuffer::from_fn(SIZE.0, SIZE.1, |x, y| Luma([(1000 * n + 20 * y + x) as u16]))
}

/// A folder that plays five pairs of images without end.
struct Folder;

impl Subject for Folder {
    fn name(&self) -> String {
        "files".into()
    }

    fn make(&self) -> Bench {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("camera.toml"), MANIFEST).unwrap();
        for n in 1..=IMAGES {
            color(n).save(dir.path().join(format!("color_{n}.png"))).unwrap();
            depth(n).save(dir.path().join(format!("depth_{n}.png"))).unwrap();
        }
        let backend = FilesBackend::new(FilesConfig::new(dir.path()));
        Bench {
            backend: Box::new(backend),
            serial: "bench".into(),
            requests: vec![],
            rig: Box::new(FolderRig(dir)),
        }
    }
}

/// The folder, kept for as long as the test runs.
struct FolderRig(TempDir);

impl Rig for FolderRig {
    fn cause(&self, trouble: Trouble) -> Result<(), Cannot> {
        assert!(self.0.path().exists());
        Err(Cannot(match trouble {
            Trouble::Unplug(_) | Trouble::Busy(_) => "a folder is neither plugged in nor held by one process",
            Trouble::Stall(_) | Trouble::Hang(_) => "reading a file cannot be made to wait",
            Trouble::HalfFrame(_) | Trouble::WrongSize(_) | Trouble::Damaged(_) => {
                "a damaged image is refused at opening or ends the stream, it is not a lost frame"
            }
            Trouble::Repeated(_) | Trouble::Skip(_) => "the driver itself counts the images",
            Trouble::TimeBackwards(_) | Trouble::ClockReset => "there is no device clock",
        }))
    }

    fn sent(&self, _: usize) -> Option<Sent> {
        None // nobody but the driver knows how many images it played
    }

    fn true_capture(&self, _: usize, _: HostTime) -> Option<(HostTime, u64)> {
        None
    }

    fn is_genuine(&self, stream: usize, pixels: &[u8]) -> Option<bool> {
        let known = |n: u32| match stream {
            0 => color(n).into_raw() == pixels,
            _ => depth(n).iter().flat_map(|d| d.to_le_bytes()).eq(pixels.iter().copied()),
        };
        Some((1..=IMAGES).any(known))
    }
}

#[test]
fn files_passes_every_case_that_a_folder_can_be_put_to() {
    let report = conformance::run(&Folder);
    println!("{report}");
    assert!(report.is_good(), "{report}");
    let device_faults = ["half_frame", "wrong_size", "damaged", "repeated", "skip", "stall"];
    let device_life = ["time_backwards", "clock_reset", "unplug", "busy", "hang", "motion"];
    assert_eq!(report.not_applicable(), [&["clock"][..], &device_faults, &device_life].concat());
}
