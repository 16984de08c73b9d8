//! Where in shared memory a slice lies: two processes that name the same place read the same bytes.
//!
//! An address means nothing outside its process, but `/proc/self/maps` says which file and offset it maps.

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

/// A byte of a mapped file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Place {
    /// Inode of the file in `/dev/shm`.
    pub inode: u64,
    /// Offset of the byte in it.
    pub offset: u64,
}

/// Where the first byte of `slice` lies.
pub fn place_of(slice: &[u8]) -> Result<Place> {
    let maps = std::fs::read_to_string("/proc/self/maps")?;
    find(&maps, slice.as_ptr() as u64).context("the frame lies in no mapped file")
}

/// Looks `address` up in the text of a `maps` file: `start-end perms offset dev inode path`.
fn find(maps: &str, address: u64) -> Option<Place> {
    let hex = |text: &str| u64::from_str_radix(text, 16).ok();
    maps.lines().find_map(|line| {
        let mut fields = line.split_ascii_whitespace();
        let (start, end) = fields.next()?.split_once('-')?;
        let start = hex(start)?;
        let end = hex(end)?;
        let offset = hex(fields.nth(1)?)?;
        let inode = fields.nth(1)?.parse().ok()?;
        (start..end).contains(&address).then(|| Place { inode, offset: offset + (address - start) })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_mapping() {
        let maps = "1000-2000 r--p 00000000 08:01 17 /lib/a\n\
                    7f00-8f00 rw-s 00003000 00:1a 4242 /dev/shm/x\n";
        assert_eq!(find(maps, 0x7f10), Some(Place { inode: 4242, offset: 0x3010 }));
        assert_eq!(find(maps, 0x8f00), None);
    }

    #[test]
    fn a_mapped_file_is_found_where_it_is() {
        // The program text is mapped from this test's own file.
        let text = b"some bytes of the program".as_slice();
        assert!(place_of(text).unwrap().inode > 0);
    }
}
