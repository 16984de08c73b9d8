//! SVO2 files: an MCAP container with side-by-side images as JPEG strips or H.264.
//!
//! The format has no official description. This reader follows what others found out about files of SDK 4 and 5
//! (`RadarML/open-svo2`, `docs/format.md`, and two independent readers) and reports an error for any other file:
//! H.265 and encrypted files (SDK 5.3) are unsupported. The vendor's own converter turns any of them into images, which
//! the folder input plays.
//!
//! | topic | holds |
//! |---|---|
//! | `svo_header` | JSON; its `header` is 128 bytes in base64: width and height of both images, serial number, rate |
//! | `Camera_SN…/side_by_side` | one message per pair, in the forms of [`payload`]; `log_time` is UTC |

use super::folder::rate_of;
use super::{DEFAULT_RATE_HZ, Next, OpenOptions, Pair, Source, SourceInfo, calibration};
use depthrig_bus::PixelFormat;
use depthrig_driver::{Error, ErrorKind, Result};
use std::path::Path;

pub mod container;
mod h264;
pub mod header;
pub mod payload;
mod strips;

use container::{Container, Message};
use h264::H264;
use header::Header;
use payload::{Footer, Payload};
use strips::Strips;

/// The cure for a file in an unsupported format.
const CONVERT: &str = "convert it with the vendor's tools (ZED_SVO_Editor, or their svo-conversion-tool container) to \
                       side-by-side images and play that folder";

/// How the images are decoded.
enum Decoder {
    Strips(Strips),
    H264(Box<H264>),
}

/// An open file.
pub(super) struct Svo2 {
    info: SourceInfo,
    container: Container,
    decoder: Decoder,
    message: Message,
    /// Number of the pair that comes next.
    next: u64,
}

impl Svo2 {
    pub(super) fn open(path: &Path, options: &OpenOptions) -> Result<Self> {
        let named = |e: Error| Error::new(e.kind(), format!("{}: {e}", path.display())).with_source(e);
        let mut container = Container::open(path)?;
        let header = Header::parse(container.header()).map_err(named)?;
        let mut message = Message::default();
        let bad = |kind, what: String| Error::new(kind, format!("{}: {what}", path.display()));
        let (decoder, (width, height)) = first_image(&mut container, &mut message, &header).map_err(named)?;
        if !header.fits(width, height) {
            let w = header.width;
            let h = header.height;
            return Err(bad(
                ErrorKind::BadInput,
                format!(
                    "its header says {w}x{h} and its images have {width}x{height} pixels; the file is damaged"
                ),
            ));
        }
        // Two pixels of YUYV share a colour, in each image.
        if !width.is_multiple_of(4) {
            let what = format!(
                "its images have {width}x{height} pixels; side-by-side YUYV has a width that is a multiple of 4"
            );
            return Err(bad(ErrorKind::BadInput, what));
        }
        let serial = options
            .serial
            .clone()
            .or_else(|| header.serial())
            .or_else(|| container.serial())
            .unwrap_or_default();
        let (calibration, calibration_origin, _) = calibration(path, options, &serial, width / 2, height)?;
        let own = f64::from(header.rate_hz);
        let recorded = Some(own).filter(|r| *r > 0.0 && *r <= super::MAX_RATE_HZ);
        let mut svo = Self {
            info: SourceInfo {
                path: path.to_owned(),
                kind: "svo2",
                model: "ZED".to_owned(),
                serial,
                width: width / 2,
                height,
                format: PixelFormat::Yuyv,
                rate_hz: options.rate_hz.or(recorded).unwrap_or(DEFAULT_RATE_HZ),
                timed: true,
                calibration,
                calibration_origin,
            },
            container,
            decoder,
            message,
            next: 0,
        };
        if options.rate_hz.is_none() && recorded.is_none() {
            svo.info.rate_hz = rate_of(svo.container.first_times()).unwrap_or(DEFAULT_RATE_HZ);
        }
        svo.seek(0)?;
        Ok(svo)
    }
}

/// The decoder for the file's images and the size of the side-by-side image, from the first of them.
fn first_image(
    container: &mut Container,
    message: &mut Message,
    header: &Header,
) -> Result<(Decoder, (u32, u32))> {
    container.seek(0)?;
    // The first ones may be damaged.
    let mut last = None;
    for _ in 0..8 {
        if !container.next(message)? {
            break;
        }
        if let Some(why) = message.damaged.take() {
            last = Some(Error::new(ErrorKind::BadInput, why));
            continue;
        }
        match Payload::parse(&message.data) {
            Payload::Strips(s) => match strips::size(&s) {
                Some(size) => return Ok((Decoder::Strips(Strips::new(size.0, size.1)), size)),
                None => last = Some(Error::new(ErrorKind::BadInput, "its first images are damaged JPEG")),
            },
            Payload::H264(unit, footer) => {
                let mut decoder = Box::new(H264::new()?);
                let size = decoder.size(unit)?.or_else(|| footer.map(Footer::size));
                match size {
                    Some(size) => return Ok((Decoder::H264(decoder), size)),
                    None => {
                        last = Some(Error::new(ErrorKind::BadInput, "its first images are damaged H.264"));
                    }
                }
            }
            Payload::H265 => {
                let what = format!("its images are H.265, which is not decoded here; {CONVERT}");
                return Err(Error::new(ErrorKind::Unsupported, what));
            }
            Payload::Unknown(why) => {
                let of = header.describe();
                let what = if header.encrypted {
                    format!("it is encrypted ({of}); only the vendor's SDK has the key: {CONVERT}")
                } else {
                    format!(
                        "its images are neither JPEG strips nor H.264 ({why}; {of}): it is encrypted, or of an SDK that \
                         writes them in another way; {CONVERT}"
                    )
                };
                return Err(Error::new(ErrorKind::Unsupported, what));
            }
        }
    }
    Err(last.unwrap_or_else(|| {
        Error::new(ErrorKind::BadInput, "it has no images; the recording was not finished, or is damaged")
    }))
}

/// The body of the fuzz target `zed_svo2`, which the test of its corpus also calls; returns the number of decoded
/// pairs.
///
/// # Panics
/// When more pairs come than the file says, or an image has another size than its strips.
#[cfg(any(test, feature = "testing"))]
pub fn fuzz(bytes: &[u8]) -> u64 {
    const MOST: u64 = 64;
    const SMALL: usize = 1 << 16;
    let file = Box::new(std::io::Cursor::new(bytes.to_vec()));
    let _ = Payload::parse(bytes);
    let Ok(mut container) = Container::new(file, bytes.len() as u64, Path::new("fuzz")) else { return 0 };
    if let Ok(header) = Header::parse(container.header()) {
        let _ = (header.describe(), header.serial());
    }
    let mut message = Message::default();
    let mut came = 0;
    let mut decoded = 0;
    while came < MOST && container.next(&mut message).unwrap_or(false) {
        came += 1;
        assert!(came <= container.frames(), "more pairs than there are");
        if let Payload::Strips(parts) = Payload::parse(&message.data)
            && message.damaged.is_none()
            && let Some((width, height)) =
                strips::size(&parts).filter(|(w, h)| (*w as usize) * (*h as usize) <= SMALL)
        {
            let image = vec![0; width as usize * height as usize];
            let mut pair = Pair { left: image.clone(), right: image, ..Pair::default() };
            decoded += u64::from(Strips::new(width, height).decode(&parts, &mut pair).is_ok());
        }
    }
    // From the middle on there are as many as were left.
    let half = container.frames() / 2;
    if container.frames() <= MOST && container.seek(half).is_ok() {
        let mut rest = 0;
        while rest < MOST && container.next(&mut message).unwrap_or(false) {
            rest += 1;
        }
        assert!(rest <= container.frames() - half, "{rest} pairs from {half} on");
    }
    decoded
}

impl Source for Svo2 {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.container.frames())
    }

    fn next(&mut self, pair: &mut Pair) -> Result<Next> {
        if !self.container.next(&mut self.message)? {
            return Ok(Next::End);
        }
        (pair.index, pair.capture_time_ns) = (self.next, self.message.time_ns);
        self.next += 1;
        if let Some(why) = self.message.damaged.take() {
            return Ok(Next::Damaged(why));
        }
        let bytes = self.info.image_bytes();
        pair.left.resize(bytes, 0);
        pair.right.resize(bytes, 0);
        let done = match (&mut self.decoder, Payload::parse(&self.message.data)) {
            (Decoder::Strips(decoder), Payload::Strips(strips)) => decoder.decode(&strips, pair),
            (Decoder::H264(decoder), Payload::H264(unit, _)) => decoder.decode(unit, &self.info, pair),
            (_, other) => Err(format!("it is {}, and the images before it are not", other.name())),
        };
        Ok(done.map_or_else(Next::Damaged, |()| Next::Pair))
    }

    fn seek(&mut self, index: u64) -> Result<()> {
        let mut from = index;
        if let Decoder::H264(decoder) = &mut self.decoder {
            decoder.restart()?;
            from = 0;
            self.container.seek(index)?;
            // An image depends on those since its key frame, whose number the file states.
            if self.container.next(&mut self.message)?
                && let Payload::H264(_, Some(footer)) = Payload::parse(&self.message.data)
                && let Some(key) = footer.key_of(index)
            {
                from = key;
            }
        }
        self.container.seek(from)?;
        self.next = from;
        let mut passed = Pair::default();
        while self.next < index {
            if self.next(&mut passed)? == Next::End {
                break;
            }
        }
        Ok(())
    }
}
