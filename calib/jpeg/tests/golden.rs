//! Decoded images are, byte for byte, those of libjpeg-turbo: Pillow and OpenCV are the witnesses.
//!
//! `golden/` holds small images and checksums of the pixels that Pillow decoded (`golden.py make`); where the repository's
//! Python is, Pillow also encodes and decodes images of random form.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_jpeg::{Form, Info, decode, decode_into, info};
use std::path::{Path, PathBuf};
use std::process::Command;

fn tests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests")
}

#[test]
fn every_form_decodes_to_the_pixels_of_pillow() {
    let folder = tests().join("golden");
    let table = std::fs::read_to_string(folder.join("golden.csv")).unwrap();
    let mut seen = 0;
    for row in table.lines().skip(1) {
        let [file, width, height, channels, crc] = row.split(',').collect::<Vec<_>>().try_into().unwrap();
        let jpeg = std::fs::read(folder.join(file)).unwrap();
        let form = if channels == "1" { Form::Grey } else { Form::Rgb };
        let expected = Info { width: width.parse().unwrap(), height: height.parse().unwrap(), form };
        assert_eq!(info(&jpeg), Ok(expected), "{file}");
        let mut pixels = vec![0xA5; expected.bytes()];
        decode_into(&jpeg, expected, &mut pixels).unwrap();
        assert_eq!(format!("{:08x}", crc32fast::hash(&pixels)), crc, "{file}");
        assert_eq!(decode(&jpeg).unwrap().pixels, pixels, "{file}");
        seen += 1;
    }
    assert_eq!(seen, 48);
}

#[test]
fn random_images_decode_to_the_pixels_of_pillow() {
    let python = std::env::var_os("PYTHON")
        .filter(|v| !v.is_empty())
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.venv/bin/python"), PathBuf::from);
    let has_pillow =
        Command::new(&python).args(["-c", "import numpy, PIL"]).output().is_ok_and(|o| o.status.success());
    if !has_pillow {
        eprintln!("skipped: {} has no Pillow; `make test` installs it", python.display());
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let made = Command::new(&python)
        .arg(tests().join("golden.py"))
        .args(["random".as_ref(), folder.path().as_os_str(), "7".as_ref()])
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let mut seen = 0;
    for entry in std::fs::read_dir(folder.path()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "jpg") {
            continue;
        }
        let pixels = decode(&std::fs::read(&path).unwrap()).unwrap().pixels;
        let wanted = std::fs::read(path.with_extension("raw")).unwrap();
        assert_eq!(pixels.len(), wanted.len(), "{}", path.display());
        assert_eq!(pixels.iter().zip(&wanted).position(|(a, b)| a != b), None, "{}", path.display());
        seen += 1;
    }
    assert_eq!(seen, 300);
}
