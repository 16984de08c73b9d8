//! A file of rendered images, mapped into memory.
//!
//! Layout, little-endian: the magic `DRSYNTH1`; u32 offset of the first image (a multiple of 4096), u32
//! planes, u32 poses, u32 length of the key; u64 bytes per image, u64 bytes of the file; the key, which is
//! everything that the images depend on as text; a u64 checksum per image; a u64 checksum of all that.
//! Then the images, plane by plane. A file is written under another name and renamed when it is complete, so
//! one that can be opened under its name was finished; length and checksums guard against what happens later.
#![allow(unsafe_code)] // memory-mapping a file, with the reason at the call

use depthrig_bus::files::NewFile;
use depthrig_driver::{Error, ErrorKind, Result};
use memmap2::Mmap;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

const MAGIC: &[u8; 8] = b"DRSYNTH1";
const FIXED: usize = 40;
const PAGE: usize = 4096;

/// A set of images of one size: `planes` kinds, `poses` of each.
#[derive(Debug)]
pub(crate) struct ImageFile {
    map: Mmap,
    first: usize,
    poses: u32,
    bytes: usize,
}

/// Expected contents of a file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wanted<'a> {
    pub(crate) key: &'a str,
    pub(crate) planes: u32,
    pub(crate) poses: u32,
    pub(crate) bytes: usize,
}

impl Wanted<'_> {
    fn images(&self) -> usize {
        self.planes as usize * self.poses as usize
    }

    fn first(&self) -> usize {
        (FIXED + self.key.len() + 8 * self.images() + 8).next_multiple_of(PAGE)
    }

    fn file_bytes(&self) -> usize {
        self.first() + self.bytes * self.images()
    }

    /// The head of the file with these checksums.
    fn head(&self, sums: &[u64]) -> Vec<u8> {
        let mut head = Vec::with_capacity(self.first());
        head.extend_from_slice(MAGIC);
        for n in [self.first() as u32, self.planes, self.poses, self.key.len() as u32] {
            head.extend_from_slice(&n.to_le_bytes());
        }
        for n in [self.bytes as u64, self.file_bytes() as u64] {
            head.extend_from_slice(&n.to_le_bytes());
        }
        head.extend_from_slice(self.key.as_bytes());
        for n in sums {
            head.extend_from_slice(&n.to_le_bytes());
        }
        head.extend_from_slice(&checksum(&head).to_le_bytes());
        head.resize(self.first(), 0);
        head
    }
}

impl ImageFile {
    /// Opens `path` if it holds what is wanted; `None` when it does not exist or must be made anew.
    pub(crate) fn open(path: &Path, wanted: &Wanted<'_>) -> Option<Self> {
        let file = depthrig_bus::files::open(path).ok()?;
        if file.metadata().ok()?.len() != wanted.file_bytes() as u64 {
            return None;
        }
        // SAFETY: the map is read-only and private to this value. depthrig never changes a finished file: it
        // renames a new one over it, which leaves this map's inode alone. Somebody who truncates the file by
        // hand while it is mapped makes this process end with SIGBUS, as with any mapped file.
        let map = unsafe { Mmap::map(&file) }.ok()?;
        let sums_at = FIXED + wanted.key.len();
        let sums: Vec<u64> = map
            .get(sums_at..sums_at + 8 * wanted.images())?
            .chunks_exact(8)
            .filter_map(|b| b.try_into().ok().map(u64::from_le_bytes))
            .collect();
        if map.get(..wanted.first())? != wanted.head(&sums) {
            return None;
        }
        let opened = Self { map, first: wanted.first(), poses: wanted.poses, bytes: wanted.bytes };
        // The ends, where a disk that was full or a power cut leaves zeros.
        let last = wanted.images() - 1;
        let is_whole = [0, last].iter().all(|i| checksum(opened.image(*i)) == sums[*i]);
        is_whole.then_some(opened)
    }

    /// Makes `path` of images that `image(plane, pose)` yields, in that order, and opens it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] naming the file when it cannot be written, and those of `image`; no file is left then.
    pub(crate) fn create(
        path: &Path,
        wanted: &Wanted<'_>,
        mut image: impl FnMut(u32) -> Result<Vec<Vec<u8>>>,
    ) -> Result<Self> {
        let io = |e: std::io::Error| {
            let what =
                format!("{}: the render cache of a synthetic camera cannot be written", path.display());
            let advice = match e.kind() {
                std::io::ErrorKind::StorageFull => {
                    "the disk is full; free some space or set cache_dir elsewhere"
                }
                _ => "check the folder's permissions or set cache_dir elsewhere",
            };
            Error::new(ErrorKind::Io, format!("{what} ({e}); {advice}")).with_source(e)
        };
        if let Some(folder) = path.parent() {
            depthrig_bus::umask::create_dir_all(folder).map_err(io)?;
        }
        let mut file = NewFile::beside(path).map_err(io)?;
        let mut sums = vec![0; wanted.images()];
        for pose in 0..wanted.poses {
            for (plane, bytes) in image(pose)?.iter().enumerate() {
                if bytes.len() != wanted.bytes || plane >= wanted.planes as usize {
                    let message = format!("{}: a rendered image has the wrong size", path.display());
                    return Err(Error::new(ErrorKind::Io, message));
                }
                let i = plane * wanted.poses as usize + pose as usize;
                sums[i] = checksum(bytes);
                file.file().seek(SeekFrom::Start((wanted.first() + i * wanted.bytes) as u64)).map_err(io)?;
                file.write_all(bytes).map_err(io)?;
            }
        }
        file.file().seek(SeekFrom::Start(0)).map_err(io)?;
        file.write_all(&wanted.head(&sums)).map_err(io)?;
        file.replace().map_err(io)?;
        Self::open(path, wanted).ok_or_else(|| {
            let message =
                format!("{}: the render cache does not read back as it was written", path.display());
            Error::new(ErrorKind::Io, message)
        })
    }

    /// The image of `plane` at `pose`; poses beyond the last show the last.
    pub(crate) fn get(&self, plane: u32, pose: u32) -> &[u8] {
        self.image((plane * self.poses + pose.min(self.poses - 1)) as usize)
    }

    fn image(&self, i: usize) -> &[u8] {
        let start = self.first + i * self.bytes;
        self.map.get(start..start + self.bytes).unwrap_or_default()
    }
}

/// A checksum that any changed byte changes; not one against malice.
fn checksum(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<8>();
    let step = |h: u64, w: u64| (h.rotate_left(5) ^ w).wrapping_mul(0x517C_C1B7_2722_0A95);
    let h = words.iter().fold(bytes.len() as u64, |h, w| step(h, u64::from_le_bytes(*w)));
    rest.iter().fold(h, |h, b| step(h, u64::from(*b)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const WANTED: Wanted<'static> = Wanted { key: "a key", planes: 2, poses: 3, bytes: 5000 };

    fn image(pose: u32) -> Vec<Vec<u8>> {
        (0..2).map(|plane| (0..5000u32).map(|i| (i * 7 + plane * 11 + pose * 13) as u8).collect()).collect()
    }

    #[test]
    fn what_is_written_is_read_and_anything_else_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("deep/er/file.images");
        assert!(ImageFile::open(&path, &WANTED).is_none());
        let made = ImageFile::create(&path, &WANTED, |pose| Ok(image(pose))).unwrap();
        for pose in 0..3 {
            assert_eq!(made.get(0, pose), image(pose)[0]);
            assert_eq!(made.get(1, pose), image(pose)[1]);
        }
        assert_eq!(made.get(0, 99), made.get(0, 2));
        assert!(ImageFile::open(&path, &WANTED).is_some());
        for other in [
            Wanted { key: "b key", ..WANTED },
            Wanted { poses: 2, ..WANTED },
            Wanted { planes: 3, poses: 2, ..WANTED },
            Wanted { bytes: 4999, ..WANTED },
        ] {
            assert!(ImageFile::open(&path, &other).is_none(), "{other:?}");
        }
        let good = std::fs::read(&path).unwrap();
        // One byte of the head, of the index, of the first and of the last image; and a cut.
        for at in [3, 41, 60, 4096 + 17, good.len() - 1] {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            std::fs::write(&path, &bad).unwrap();
            assert!(ImageFile::open(&path, &WANTED).is_none(), "byte {at}");
        }
        std::fs::write(&path, &good[..good.len() - 1]).unwrap();
        assert!(ImageFile::open(&path, &WANTED).is_none());
        std::fs::write(&path, &good).unwrap();
        assert!(ImageFile::open(&path, &WANTED).is_some());
        assert_eq!(
            std::fs::read_dir(path.parent().unwrap()).unwrap().count(),
            1,
            "no temporary file is left"
        );
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("in_the_way");
        std::fs::write(&file, b"x").unwrap();
        let e = ImageFile::create(&file.join("a.images"), &WANTED, |pose| Ok(image(pose)));
        let e = e.unwrap_err();
        assert!(e.to_string().contains("in_the_way") && e.to_string().contains("cache_dir"), "{e}");
        assert_eq!(e.kind(), ErrorKind::Io);
    }
}
