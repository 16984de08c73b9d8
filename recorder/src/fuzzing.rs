//! What the fuzz targets in `fuzz/` call, and the test that runs their corpus: bytes that may be anything, through
//! the ways in that a file has. `docs/fuzzing.md` says how they are run.
//!
//! A panic is a finding; so is a broken promise, which is why there are assertions here. Each function returns how
//! far its input came, so that a corpus which no longer reaches anything is noticed.

use crate::codec::{DepthDecoder, DepthEncoder, DepthShape};
use crate::dataset::color_decodes;
use crate::fs::{Fs, MemFs};
use crate::msgs::image;
use crate::recorder::topics::Topics;
use crate::recover::{RecoverOptions, recover_with};
use crate::{
    Dataset, PixelMode, RecorderOptions, SESSION_FILE, Session, SetRange, VerifyOptions, verify_with,
};
use core::ops::ControlFlow;
use depthrig_bus::{FrameHeader, PixelFormat};
use std::path::Path;
use std::sync::Arc;

pub mod mcap;

/// A folder in memory with one file in it.
fn folder(name: &str, bytes: &[u8]) -> (Arc<dyn Fs>, &'static Path) {
    let (fs, dir) = (MemFs::new(), Path::new("/d"));
    // Cannot fail: nothing fails on this file system unless told to.
    drop(fs.create_dir_all(dir));
    fs.put(&dir.join(name), bytes.to_vec());
    (Arc::new(fs), dir)
}

/// A segment on its own in a folder, opened, read and verified; the number of its sets that can be decoded.
///
/// # Panics
/// When what `verify` finds whole cannot be read.
pub fn segment(bytes: &[u8]) -> u64 {
    let (fs, dir) = folder("seg_0000.mcap", bytes);
    let options = VerifyOptions { decode: true, ..VerifyOptions::default() };
    let report = verify_with(&fs, dir, &options).ok();
    let Ok(dataset) = Dataset::open_with(fs, dir) else { return 0 };
    drop(dataset.info());
    let good = |mode| dataset.sets_with(SetRange::ALL, mode).filter_map(Result::ok).count() as u64;
    let (decoded, marked) = (good(PixelMode::Decoded), good(PixelMode::None));
    // The missing session.toml is always found; anything else that is wrong with the file has a place in it.
    let broken_here = |f: &crate::Finding| f.severity > crate::Severity::Note && f.file != SESSION_FILE;
    if let Some(report) = report.filter(|r| !r.findings.iter().any(broken_here)) {
        let sets = report.sets;
        assert_eq!((decoded, marked), (sets, sets), "verified as whole, and not all sets can be read");
    }
    decoded
}

/// A segment, unfinished by its name when it has an odd number of bytes, recovered; the number of its sets.
///
/// # Panics
/// When what was recovered cannot be opened or holds more than was said, or recovering it again changes it.
pub fn recover(bytes: &[u8]) -> u64 {
    let name = if bytes.len() % 2 == 1 { "seg_0000.mcap.part" } else { "seg_0000.mcap" };
    let (fs, dir) = folder(name, bytes);
    let recover = || recover_with(&fs, dir, &RecoverOptions::default(), &mut |_| ControlFlow::Continue(()));
    let Ok(first) = recover() else { return 0 };
    let Ok(dataset) = Dataset::open_with(Arc::clone(&fs), dir) else {
        panic!("recovered and cannot be opened: {first:?}");
    };
    let report = verify_with(&fs, dir, &VerifyOptions::default());
    let broken = report.as_ref().ok().and_then(crate::VerifyReport::broken);
    assert!(report.is_ok() && broken.is_none(), "recovered, and verify finds {broken:?}\nafter {first:?}");
    // Fewer can be: the pixels of a set are not decoded by a recovery.
    let sets = dataset.sets_with(SetRange::ALL, PixelMode::Stored).flatten().count();
    assert!(sets as u64 <= first.sets, "{first:?}, and then {sets} are read");
    let again = recover();
    assert!(again.as_ref().is_ok_and(|r| !r.changed), "recovering again: {again:?}\nafter {first:?}");
    first.sets
}

/// A `session.toml`, alone in its folder: read, used as a recorder would, written and read again; whether it
/// could be read.
///
/// # Panics
/// When a session changes by being written and read.
pub fn session(bytes: &[u8]) -> bool {
    let (fs, dir) = folder(SESSION_FILE, bytes);
    drop(verify_with(&fs, dir, &VerifyOptions::default()));
    let Ok(dataset) = Dataset::open_with(fs, dir) else { return false };
    drop(dataset.info());
    let session = dataset.session();
    if session.check().is_ok() {
        drop(Topics::new(session, &RecorderOptions::default()).preamble(session, 0));
    }
    // Compared as text, because a session may hold NaN.
    if let Ok(text) = session.to_toml() {
        let again = Session::from_toml(&text, dir).and_then(|s| s.to_toml());
        assert!(again.is_ok_and(|again| again == text), "a session changes by being written and read");
    }
    true
}

/// The depth codec. The first four bytes say what the rest is and the shape of the picture: a packed picture, the same
/// before it is compressed (so that mutations reach what is in it), or pixels to be packed. The whole is read as the
/// message of such a picture too. Whether there is a picture in the end.
///
/// # Panics
/// When a picture is another one after being packed and unpacked.
pub fn depth_codec(bytes: &[u8]) -> bool {
    let (mut encoder, mut decoder, mut picture) = (DepthEncoder::new(), DepthDecoder::new(), Vec::new());
    let message = image::read_compressed_depth(bytes);
    let message = message.and_then(|(shape, _, data)| decoder.decode(data, shape, &mut picture));
    let Some((&[kind, width, height, pad], rest)) = bytes.split_first_chunk() else { return message.is_ok() };
    let [width, height] = [width, height].map(u32::from);
    let shape = DepthShape { width, height, step: 2 * width + u32::from(pad) % 8 };
    let decoded = match (kind % 3, rest.split_first_chunk::<4>()) {
        (0, _) => decoder.decode(rest, shape, &mut picture),
        (1, Some((count, body))) => {
            let Ok(packed) = zstd::bulk::compress(body, 1) else { return false };
            decoder.decode(&[&count[..], &packed].concat(), shape, &mut picture)
        }
        _ if width * height == 0 => return message.is_ok(),
        _ => {
            picture.clear();
            picture.extend(rest.iter().cycle().take(shape.bytes() as usize));
            picture.resize(shape.bytes() as usize, 0);
            Ok(())
        }
    };
    if decoded.is_err() {
        return message.is_ok();
    }
    let (mut packed, mut again) = (Vec::new(), Vec::new());
    let done = encoder.encode(&picture, shape, &mut packed);
    let done = done.and_then(|()| decoder.decode(&packed, shape, &mut again));
    assert!(done.is_ok() && again == picture, "a picture changes by being packed: {done:?}");
    true
}

/// A PNG or a JPEG of a colour stream, under a header of the size in the first two bytes; whether it was one.
pub fn color_codec(bytes: &[u8]) -> bool {
    let Some(([width, height], data)) = bytes.split_first_chunk::<2>() else { return false };
    let mut h = FrameHeader::default();
    h.set_picture(PixelFormat::Rgb8, u32::from(*width), u32::from(*height));
    color_decodes(data, &h)
}

/// A line of the `frames.csv` of an export; whether it is one.
///
/// # Panics
/// When a line changes by being read and written.
pub fn frames_csv(bytes: &[u8]) -> bool {
    core::str::from_utf8(bytes).is_ok_and(crate::exchange::fuzzing::row)
}

/// The `calibration.json` of an export; whether it is one.
pub fn calibration_json(bytes: &[u8]) -> bool {
    crate::exchange::fuzzing::calibration(bytes)
}

/// An NPY file; whether it is an array that can be imported.
pub fn npy(bytes: &[u8]) -> bool {
    crate::exchange::fuzzing::npy(bytes)
}

/// A rosbag, read to its end; how many frames came out.
///
/// # Panics
/// When the accounts of what came out do not balance.
pub fn rosbag(bytes: &[u8]) -> u64 {
    let (fs, dir) = folder("fuzz.bag", bytes);
    fs.open(&dir.join("fuzz.bag")).map_or(0, crate::exchange::fuzzing::rosbag)
}
