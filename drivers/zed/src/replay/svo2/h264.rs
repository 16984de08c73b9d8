//! H.264 by `openh264`, a shared library that is loaded if a file needs it.
//!
//! Both images come as 4:2:0; the pairs are given as YUYV with the luminance as it is and each row of colour twice.
#![allow(unsafe_code)] // a library that is loaded at run time has to be trusted

use super::super::{Pair, SourceInfo};
use depthrig_driver::{Error, ErrorKind, Result};
use openh264::OpenH264API;
use openh264::decoder::{DecodedYUV, Decoder, DecoderConfig, Flush};
use openh264::formats::YUVSource;
use std::ffi::OsString;

/// Where the library is looked for when this does not say it.
const VARIABLE: &str = "DEPTHRIG_OPENH264";
/// Names of the library, the version of Debian 12 first. The decoder's interface is the same in all of them.
const NAMES: [&str; 3] = ["libopenh264.so.7", "libopenh264.so.8", "libopenh264.so"];
/// Symbols that the library must have.
const SYMBOLS: [&[u8]; 3] = [b"WelsCreateDecoder\0", b"WelsDestroyDecoder\0", b"WelsGetCodecVersion\0"];

/// A decoder in its state between two images.
pub(super) struct H264 {
    decoder: Owned,
}

/// A decoder of the library.
struct Owned(Decoder);

// SAFETY: the decoder's memory is its own, OpenH264 keeps nothing per thread, and one thread uses it at a time.
unsafe impl Send for Owned {}

impl H264 {
    /// Loads the library.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] if the library is missing, with what to install.
    pub(super) fn new() -> Result<Self> {
        Ok(Self { decoder: Owned(decoder()?) })
    }

    /// Forgets all images.
    pub(super) fn restart(&mut self) -> Result<()> {
        self.decoder = Owned(decoder()?);
        Ok(())
    }

    /// The size of the image in `unit`; `None` if it cannot be decoded.
    pub(super) fn size(&mut self, unit: &[u8]) -> Result<Option<(u32, u32)>> {
        let size = match self.decoder.0.decode(unit) {
            Ok(image) => image.map(|p| p.dimensions()),
            Err(_) => None,
        };
        self.restart()?;
        Ok(size.and_then(|(w, h)| Some((u32::try_from(w).ok()?, u32::try_from(h).ok()?))))
    }

    /// Decodes the next image into `pair`, whose images have their size; why it cannot otherwise.
    pub(super) fn decode(&mut self, unit: &[u8], info: &SourceInfo, pair: &mut Pair) -> Result<(), String> {
        match self.decoder.0.decode(unit) {
            Ok(Some(image)) => halves(&image, info, pair),
            Ok(None) => Err("the decoder has no image for it; it needs one that is not there".to_owned()),
            Err(e) => Err(format!("it cannot be decoded: {e}")),
        }
    }
}

fn halves(image: &DecodedYUV<'_>, info: &SourceInfo, pair: &mut Pair) -> Result<(), String> {
    let (width, height) = image.dimensions();
    let half = info.width as usize;
    let rows = info.height as usize;
    if (width, height) != (2 * half, rows) {
        return Err(format!("it has {width}x{height} pixels, and the images before it {}x{rows}", 2 * half));
    }
    let (sy, su, sv) = image.strides();
    let (y, u, v) = (image.y(), image.u(), image.v());
    for (from, out) in [(0, &mut pair.left), (half, &mut pair.right)] {
        for (row, out) in out.chunks_exact_mut(2 * half).enumerate() {
            let y = y.get(row * sy + from..row * sy + from + half);
            let u = u.get(row / 2 * su + from / 2..row / 2 * su + from / 2 + half / 2);
            let v = v.get(row / 2 * sv + from / 2..row / 2 * sv + from / 2 + half / 2);
            let (Some(y), Some(u), Some(v)) = (y, u, v) else {
                return Err("the decoder gave less than an image".to_owned());
            };
            for (((out, y), u), v) in out.chunks_exact_mut(4).zip(y.chunks_exact(2)).zip(u).zip(v) {
                out.copy_from_slice(&[y[0], *u, y[1], *v]);
            }
        }
    }
    Ok(())
}

fn decoder() -> Result<Decoder> {
    let given = std::env::var_os(VARIABLE).filter(|v| !v.is_empty());
    let names: Vec<OsString> = given.map_or_else(|| NAMES.map(OsString::from).into(), |path| vec![path]);
    let mut why = String::new();
    for name in names {
        match load(&name) {
            Ok(api) => {
                let config = DecoderConfig::new().flush_after_decode(Flush::Flush);
                return Decoder::with_api_config(api, config).map_err(|e| {
                    let what = format!("{} makes no decoder: {e}", name.display());
                    Error::new(ErrorKind::Unsupported, what).with_source(e)
                });
            }
            Err(e) => why = e,
        }
    }
    let what = format!(
        "its images are H.264, and there is no OpenH264 to decode them ({why}); install it (Debian: apt install \
         libopenh264-7), or name the library in {VARIABLE}"
    );
    Err(Error::new(ErrorKind::Unsupported, what))
}

/// Loads the library, if it is one that has a decoder.
fn load(name: &OsString) -> Result<OpenH264API, String> {
    // SAFETY: loading runs the library's initialisers; the user, or the system, put it there to be loaded.
    let library = unsafe { libloading::Library::new(name) }.map_err(|e| e.to_string())?;
    for symbol in SYMBOLS {
        // SAFETY: only its presence is checked; it is not called.
        let found = unsafe { library.get::<unsafe extern "C" fn()>(symbol) };
        found.map_err(|e| format!("{} is not OpenH264: {e}", name.display()))?;
    }
    // SAFETY: it has the functions of OpenH264; those of the decoder are the same from 1.x to 2.6.
    unsafe { OpenH264API::from_blob_path_unchecked(name) }.map_err(|e| e.to_string())
}
