//! Entry points of the fuzz targets in `fuzz/` and of the test that runs their corpus: each feeds arbitrary bytes to a
//! reader of files. `docs/fuzzing.md` says how to run them.
//!
//! A panic is a finding; so is a violated guarantee, which is why there are assertions here. Each function returns how
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
    let fs = MemFs::new();
    let dir = Path::new("/d");
    // Cannot fail: no fault is injected into this file system.
    drop(fs.create_dir_all(dir));
    fs.put(&dir.join(name), bytes.to_vec());
    (Arc::new(fs), dir)
}

/// Opens, reads and verifies a segment on its own in a folder; returns the number of decodable sets.
///
/// # Panics
/// When a segment without a finding of `verify` cannot be read.
pub fn segment(bytes: &[u8]) -> u64 {
    let (fs, dir) = folder("seg_0000.mcap", bytes);
    let options = VerifyOptions { decode: true, ..VerifyOptions::default() };
    let report = verify_with(&fs, dir, &options).ok();
    let Ok(dataset) = Dataset::open_with(fs, dir) else { return 0 };
    drop(dataset.info());
    let good = |mode| dataset.sets_with(SetRange::ALL, mode).filter_map(Result::ok).count() as u64;
    let decoded = good(PixelMode::Decoded);
    let marked = good(PixelMode::None);
    // The missing session.toml is always a finding; every other finding names a place in the file.
    let broken_here = |f: &crate::Finding| f.severity > crate::Severity::Note && f.file != SESSION_FILE;
    if let Some(report) = report.filter(|r| !r.findings.iter().any(broken_here)) {
        let sets = report.sets;
        assert_eq!((decoded, marked), (sets, sets), "verified as complete, but not all sets can be read");
    }
    decoded
}

/// Recovers a segment, named as unfinished if it has an odd number of bytes; returns the number of its sets.
///
/// # Panics
/// When the recovered segment cannot be opened or holds more than reported, or a second recovery changes it.
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
    // Fewer are possible: a recovery does not decode the pixels of a set.
    let sets = dataset.sets_with(SetRange::ALL, PixelMode::Stored).flatten().count();
    assert!(sets as u64 <= first.sets, "{first:?}, and then {sets} are read");
    let again = recover();
    assert!(again.as_ref().is_ok_and(|r| !r.changed), "recovering again: {again:?}\nafter {first:?}");
    first.sets
}

/// A `session.toml`, alone in its folder: read, used as by a recorder, written and read again; returns whether it could
/// be read.
///
/// # Panics
/// When writing and reading changes a session.
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

/// The depth codec. The first four bytes select the kind of the rest and the shape of the image: a packed image, the
/// same before compression (so that mutations reach its contents), or pixels to pack. All bytes are also read as the
/// message of such an image. Returns whether they give an image.
///
/// # Panics
/// When packing and unpacking changes an image.
pub fn depth_codec(bytes: &[u8]) -> bool {
    let mut encoder = DepthEncoder::new();
    let mut decoder = DepthDecoder::new();
    let mut image = Vec::new();
    let message = image::read_compressed_depth(bytes);
    let message = message.and_then(|(shape, _, data)| decoder.decode(data, shape, &mut image));
    let Some((&[kind, width, height, pad], rest)) = bytes.split_first_chunk() else { return message.is_ok() };
    let [width, height] = [width, height].map(u32::from);
    let shape = DepthShape { width, height, step: 2 * width + u32::from(pad) % 8 };
    let decoded = match (kind % 3, rest.split_first_chunk::<4>()) {
        (0, _) => decoder.decode(rest, shape, &mut image),
        (1, Some((count, body))) => {
            let Ok(packed) = zstd::bulk::compress(body, 1) else { return false };
            decoder.decode(&[&count[..], &packed].concat(), shape, &mut image)
        }
        _ if width * height == 0 => return message.is_ok(),
        _ => {
            image.clear();
            image.extend(rest.iter().cycle().take(shape.bytes() as usize));
            image.resize(shape.bytes() as usize, 0);
            Ok(())
        }
    };
    if decoded.is_err() {
        return message.is_ok();
    }
    let mut packed = Vec::new();
    let mut again = Vec::new();
    let done = encoder.encode(&image, shape, &mut packed);
    let done = done.and_then(|()| decoder.decode(&packed, shape, &mut again));
    assert!(done.is_ok() && again == image, "an image changes by being packed: {done:?}");
    true
}

/// A PNG or a JPEG of a colour stream, under a header of the size in the first two bytes; whether it was one.
pub fn color_codec(bytes: &[u8]) -> bool {
    let Some(([width, height], data)) = bytes.split_first_chunk::<2>() else { return false };
    let mut h = FrameHeader::default();
    h.set_image(PixelFormat::Rgb8, u32::from(*width), u32::from(*height));
    color_decodes(data, &h)
}
