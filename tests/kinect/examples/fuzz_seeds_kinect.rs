//! Writes the seeds of the fuzz targets of Azure Kinect recordings: `fuzz_seeds_kinect FOLDER`, where `FOLDER` has one
//! folder for each target.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a tool for tests: any failure ends it

use depthrig_kinect_fixture::{CALIBRATION, Fixture, Images, Lacing};
use std::io::Cursor;
use std::path::PathBuf;

/// Images of a few bytes: the reader of a recording does not look inside of them.
struct Tiny;

impl Images for Tiny {
    fn color(&mut self, n: u32) -> Vec<u8> {
        vec![0xFF, 0xD8, n as u8, 0xFF, 0xD9]
    }

    fn depth(&mut self, n: u32) -> Vec<u16> {
        vec![n as u16; 4]
    }

    fn infrared(&mut self, n: u32) -> Vec<u16> {
        vec![7 * n as u16; 4]
    }
}

fn main() {
    let folder = std::env::args().nth(1).map(PathBuf::from).expect("the folder of the corpus");
    let fixture = || Fixture { captures: 3, calibration: Some("{}".into()), ..Fixture::default() };
    let seeds = [
        ("sdk", Fixture { calibration: Some(CALIBRATION.into()), ..fixture() }),
        ("plain", Fixture { checksums: false, ..fixture() }),
        ("open", Fixture { open_sizes: true, checksums: false, index: false, ..fixture() }),
        ("behind", Fixture { tags_behind: true, checksums: false, ..fixture() }),
        ("early", Fixture { early: true, checksums: false, lacing: Lacing::Xiph, ..fixture() }),
        ("laced", Fixture { checksums: false, lacing: Lacing::Ebml, ..fixture() }),
        ("long", Fixture { captures: 40, checksums: false, motion: false, ..fixture() }),
    ];
    let target = folder.join("kinect_mkv");
    std::fs::create_dir_all(&target).unwrap();
    for (name, fixture) in seeds {
        let mut out = Cursor::new(Vec::new());
        fixture.write_to(&mut out, &mut Tiny).unwrap();
        std::fs::write(target.join(format!("seed_{name}")), out.into_inner()).unwrap();
    }
    let target = folder.join("kinect_calibration");
    std::fs::create_dir_all(&target).unwrap();
    std::fs::write(target.join("seed_device"), CALIBRATION).unwrap();
    let prototype = CALIBRATION.replace("BrownConrady", "Rational6KT").replace("3072", "2304");
    std::fs::write(target.join("seed_prototype"), prototype).unwrap();
}
