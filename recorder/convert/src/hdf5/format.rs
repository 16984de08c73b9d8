//! A small part of the HDF5 File Format Specification, version 3.0: what a file of groups, arrays and attributes needs.
//!
//! ```text
//! superblock │ packed images, as the parts wrote them │ arrays, B-trees, heaps and object headers, the root last
//! ```
//!
//! All addresses are known before the first byte is written, so a file is written front to back, through the same file system as every other
//! file of an export. Superblock 2, headers 2 and B-trees 1 are read by every HDF5 from 1.8 (2008) on.
//!
//! Why not a crate: `hdf5-metno` builds or links the C library. `rust-hdf5` 0.7 and `hdf5-pure` 0.47 are pure Rust and young; they read and edit as well, in many times
//! the code, and write to a path of the real disk, past [`depthrig_recorder::fs`] and its tests of faults.

use super::checksum::lookup3;

/// Bytes before the packed images.
pub(super) const SUPERBLOCK_BYTES: u64 = 48;
/// The address of what is not there.
const UNDEFINED: u64 = u64::MAX;
/// Children of a node of a B-tree of chunks at most: twice the default K of the library, which this superblock implies.
const NODE_CHILDREN: usize = 64;
/// The smallest heap that the library accepts, bytes.
const HEAP_BYTES: usize = 4096;
/// Bytes before an object of a heap.
const HEAP_OBJECT: usize = 16;

/// Type of the numbers of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    U8,
    U16,
    I64,
    F32,
    /// NumPy's bool, as h5py stores it.
    Bool,
    /// Text of so many bytes, padded with zeros.
    Text(u32),
}

impl Kind {
    pub(super) const fn bytes(self) -> u32 {
        match self {
            Self::U8 | Self::Bool => 1,
            Self::U16 => 2,
            Self::F32 => 4,
            Self::I64 => 8,
            Self::Text(bytes) => bytes,
        }
    }

    /// The datatype message.
    fn message(self) -> Vec<u8> {
        let mut m = Message::default();
        match self {
            Self::U8 | Self::U16 | Self::I64 => integer(self.bytes(), self == Self::I64),
            Self::F32 => {
                // Little-endian, the highest bit of the mantissa implied, the sign in bit 31.
                m.bytes(&[0x11, 0x20, 31, 0]).u32(4).u16(0).u16(32).bytes(&[23, 8, 0, 23]).u32(127);
                m.0
            }
            Self::Bool => {
                m.bytes(&[0x38, 2, 0, 0]).u32(1).bytes(&integer(1, true)).bytes(b"FALSE\0TRUE\0\0\x01");
                m.0
            }
            Self::Text(bytes) => {
                m.bytes(&[0x13, 0x11, 0, 0]).u32(bytes);
                m.0
            }
        }
    }
}

fn integer(bytes: u32, is_signed: bool) -> Vec<u8> {
    let mut m = Message::default();
    m.bytes(&[0x10, u8::from(is_signed) << 3, 0, 0]).u32(bytes).u16(0).u16(8 * bytes as u16);
    m.0
}

/// A value of an attribute.
#[derive(Debug, Clone)]
pub(super) enum Attribute {
    Int(i64),
    Bool(bool),
    /// Text of any length, which h5py returns as `str`.
    Text(String),
}

/// The packed image of a row.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chunk {
    pub(super) row: u64,
    pub(super) address: u64,
    pub(super) bytes: u32,
}

/// An address in the file, at which an object begins.
#[derive(Debug, Clone, Copy)]
pub(super) struct Address(u64);

/// The part of a file behind its images, as it grows.
#[derive(Debug)]
pub(super) struct Objects {
    /// The address of the first byte.
    begin: u64,
    bytes: Vec<u8>,
}

impl Objects {
    /// Behind packed images of this many bytes.
    pub(super) const fn behind(images: u64) -> Self {
        Self { begin: SUPERBLOCK_BYTES + images, bytes: Vec::new() }
    }

    /// Adds a group of objects that were added before.
    pub(super) fn group(
        &mut self,
        members: &[(String, Address)],
        attributes: &[(&str, Attribute)],
    ) -> Address {
        let mut header = Header::default();
        header.add(0x02, Message::default().bytes(&[0, 0]).u64(UNDEFINED).u64(UNDEFINED));
        header.add(0x0a, Message::default().bytes(&[0, 0]));
        for (name, address) in members {
            // A hard link; its name is UTF-8, its length 2 bytes.
            let mut link = Message::default();
            link.bytes(&[1, 0x11, 1]).u16(name.len() as u16).bytes(name.as_bytes()).u64(address.0);
            header.add(0x06, &link);
        }
        self.attributes(&mut header, attributes);
        self.put(&header.finish())
    }

    /// Adds an array whose values are `data`, the last index fastest.
    pub(super) fn array(&mut self, kind: Kind, shape: &[u64], data: &[u8]) -> Address {
        let address = if data.is_empty() { UNDEFINED } else { self.put(data).0 };
        let mut header = array_header(kind, shape, 0x0a);
        header.add(0x08, Message::default().bytes(&[3, 1]).u64(address).u64(data.len() as u64));
        self.put(&header.finish())
    }

    /// Adds an array of images packed by [`pack`], a chunk each; a row without one reads as zeros. `chunks` are in the order of rows.
    pub(super) fn images(&mut self, kind: Kind, shape: &[u64], chunks: &[Chunk]) -> Address {
        let address = self.tree(shape.len(), chunks);
        let mut header = array_header(kind, shape, 0x0b);
        let mut layout = Message::default();
        layout.bytes(&[3, 2, shape.len() as u8 + 1]).u64(address).u32(1);
        for n in shape.iter().skip(1) {
            layout.u32(*n as u32);
        }
        header.add(0x08, layout.u32(kind.bytes()));
        // Shuffle, then deflate.
        let mut filters = Message::default();
        filters.bytes(&[2, 2]).u16(2).u16(1).u16(1).u32(kind.bytes()).u16(1).u16(1).u16(1).u32(LEVEL);
        header.add(0x0b, &filters);
        self.put(&header.finish())
    }

    /// The superblock of the file with this root, and everything behind the images.
    pub(super) fn finish(self, root: Address) -> (Vec<u8>, Vec<u8>) {
        let mut superblock = Message::default();
        superblock.bytes(b"\x89HDF\r\n\x1a\n").bytes(&[2, 8, 8, 0]).u64(0).u64(UNDEFINED);
        superblock.u64(self.begin + self.bytes.len() as u64).u64(root.0);
        (checked(superblock.0), self.bytes)
    }

    fn put(&mut self, bytes: &[u8]) -> Address {
        let address = self.begin + self.bytes.len() as u64;
        self.bytes.extend_from_slice(bytes);
        Address(address)
    }

    /// The B-tree of an array's chunks; its address.
    fn tree(&mut self, rank: usize, chunks: &[Chunk]) -> u64 {
        // A key is the size of the chunk, its filters that were left out, and its first element.
        let key = |row: u64, bytes: u32| {
            let mut key = Message::default();
            key.u32(bytes).u32(0).u64(row).bytes(&vec![0; 8 * rank]);
            key.0
        };
        let Some(last) = chunks.last() else { return UNDEFINED };
        let end = key(last.row + 1, 0);
        let mut children: Vec<_> = chunks.iter().map(|c| (key(c.row, c.bytes), c.address)).collect();
        for level in 0_u8.. {
            // Nodes of a level have one size, so that each knows its neighbours.
            let bytes = 24 + NODE_CHILDREN * 8 + (NODE_CHILDREN + 1) * end.len();
            let first = self.begin + self.bytes.len() as u64;
            let count = children.len().div_ceil(NODE_CHILDREN);
            let neighbour =
                |i: Option<usize>| i.filter(|i| *i < count).map_or(UNDEFINED, |i| first + (i * bytes) as u64);
            let mut parents = Vec::with_capacity(count);
            for (i, group) in children.chunks(NODE_CHILDREN).enumerate() {
                let mut node = Message::default();
                node.bytes(b"TREE").bytes(&[1, level]).u16(group.len() as u16);
                node.u64(neighbour(i.checked_sub(1))).u64(neighbour(Some(i + 1)));
                for (key, address) in group {
                    node.bytes(key).u64(*address);
                }
                let next = children.get((i + 1) * NODE_CHILDREN);
                node.bytes(next.map_or(&end, |(key, _)| key));
                node.0.resize(bytes, 0);
                parents.push((group[0].0.clone(), self.put(&node.0).0));
            }
            if let [(_, root)] = parents[..] {
                return root;
            }
            children = parents;
        }
        UNDEFINED
    }

    /// Adds attributes to a header, and their texts as a heap of their own.
    fn attributes(&mut self, header: &mut Header, attributes: &[(&str, Attribute)]) {
        let texts: Vec<_> = attributes
            .iter()
            .filter_map(|(_, a)| if let Attribute::Text(text) = a { Some(text.as_str()) } else { None })
            .collect();
        let heap = if texts.is_empty() { UNDEFINED } else { self.put(&heap(&texts)).0 };
        let mut texts = 0;
        for (name, value) in attributes {
            let mut data = Message::default();
            let kind = match value {
                Attribute::Int(value) => {
                    data.u64(*value as u64);
                    Kind::I64.message()
                }
                Attribute::Bool(value) => {
                    data.bytes(&[u8::from(*value)]);
                    Kind::Bool.message()
                }
                Attribute::Text(text) => {
                    texts += 1;
                    data.u32(text.len() as u32).u64(heap).u32(texts);
                    // A sequence of bytes that is text, UTF-8.
                    let mut kind = Message::default();
                    kind.bytes(&[0x19, 1, 1, 0]).u32(16).bytes(&integer(1, false));
                    kind.0
                }
            };
            let space = [2, 0, 0, 0];
            let mut attribute = Message::default();
            attribute
                .bytes(&[3, 0])
                .u16(name.len() as u16 + 1)
                .u16(kind.len() as u16)
                .u16(space.len() as u16);
            attribute
                .bytes(&[1])
                .bytes(name.as_bytes())
                .bytes(&[0])
                .bytes(&kind)
                .bytes(&space)
                .bytes(&data.0);
            header.add(0x0c, &attribute);
        }
    }
}

/// The level of deflate: the fastest.
const LEVEL: u32 = 1;

/// Packs an image of numbers of `kind` as the filters of [`Objects::images`] say.
pub(super) fn pack(kind: Kind, pixels: &[u8]) -> std::io::Result<Vec<u8>> {
    use std::io::Write;
    let size = kind.bytes() as usize;
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::new(LEVEL));
    if size == 1 {
        encoder.write_all(pixels)?;
    } else {
        let shuffled: Vec<u8> =
            (0..size).flat_map(|i| pixels.iter().skip(i).step_by(size).copied()).collect();
        encoder.write_all(&shuffled)?;
    }
    encoder.finish()
}

/// Type and shape of an array; `fill` is when room is taken and filled with zeros.
fn array_header(kind: Kind, shape: &[u64], fill: u8) -> Header {
    let mut header = Header::default();
    let mut space = Message::default();
    space.bytes(&[2, shape.len() as u8, 0, 1]);
    for n in shape {
        space.u64(*n);
    }
    header.add(0x01, &space);
    header.add(0x03, &Message(kind.message()));
    header.add(0x05, Message::default().bytes(&[3, fill]));
    header
}

/// A global heap of texts, which are numbered from 1.
fn heap(texts: &[&str]) -> Vec<u8> {
    let used: usize = texts.iter().map(|t| HEAP_OBJECT + t.len().next_multiple_of(8)).sum();
    let bytes = (16 + used + HEAP_OBJECT).max(HEAP_BYTES);
    let mut heap = Message::default();
    heap.bytes(b"GCOL").bytes(&[1, 0, 0, 0]).u64(bytes as u64);
    for (i, text) in texts.iter().enumerate() {
        heap.u16(i as u16 + 1).u16(1).u32(0).u64(text.len() as u64).bytes(text.as_bytes());
        heap.0.resize(heap.0.len().next_multiple_of(8), 0);
    }
    // Object 0 is the room that is left.
    heap.u64(0).u64((bytes - 16 - used) as u64);
    heap.0.resize(bytes, 0);
    heap.0
}

/// Appends its checksum to a structure.
fn checked(mut bytes: Vec<u8>) -> Vec<u8> {
    let sum = lookup3(&bytes);
    bytes.extend(sum.to_le_bytes());
    bytes
}

/// Bytes of a structure, as it grows.
#[derive(Debug, Clone, Default)]
struct Message(Vec<u8>);

impl Message {
    fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn u16(&mut self, value: u16) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    fn u32(&mut self, value: u32) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    fn u64(&mut self, value: u64) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }
}

/// The messages of an object.
#[derive(Debug, Default)]
struct Header(Message);

impl Header {
    fn add(&mut self, kind: u8, message: &Message) {
        self.0.bytes(&[kind]).u16(message.0.len() as u16).bytes(&[0]).bytes(&message.0);
    }

    fn finish(self) -> Vec<u8> {
        let mut header = Message::default();
        // The size of the messages has 4 bytes.
        header.bytes(b"OHDR").bytes(&[2, 2]).u32(self.0.0.len() as u32).bytes(&self.0.0);
        checked(header.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn number(bytes: &[u8], at: usize, size: usize) -> u64 {
        bytes[at..at + size].iter().rev().fold(0, |n, b| n << 8 | u64::from(*b))
    }

    /// Adds row, address and bytes of each chunk below a node; the node's level.
    fn walk(objects: &Objects, address: u64, rank: usize, found: &mut Vec<(u64, u64, u64)>) -> u64 {
        let node = &objects.bytes[at_of(objects, address)..];
        assert_eq!((&node[..4], node[4]), (&b"TREE"[..], 1));
        let key = 8 + 8 * (rank + 1);
        let count = number(node, 6, 2) as usize;
        assert!((1..=NODE_CHILDREN).contains(&count));
        for i in 0..count {
            let at = 24 + i * (key + 8);
            let child = number(node, at + key, 8);
            let row = number(node, at + 8, 8);
            // A chunk is looked for where the key before it and the one after it enclose its row.
            assert!(row < number(node, at + key + 16, 8));
            if node[5] == 0 {
                found.push((row, child, number(node, at, 4)));
            } else {
                assert_eq!(number(&objects.bytes[at_of(objects, child)..], 32, 8), row);
                walk(objects, child, rank, found);
            }
        }
        u64::from(node[5])
    }

    fn at_of(objects: &Objects, address: u64) -> usize {
        (address - objects.begin) as usize
    }

    proptest! {
        #[test]
        fn a_tree_has_every_image_once(gaps in proptest::collection::vec(1_u64..4, 1..9000)) {
            let rows = gaps.iter().scan(0, |row, gap| { *row += gap; Some(*row) });
            let chunks: Vec<_> = rows.enumerate()
                .map(|(i, row)| Chunk { row, address: 48 + 7 * i as u64, bytes: i as u32 + 1 })
                .collect();
            let mut objects = Objects::behind(7 * chunks.len() as u64);
            let root = objects.tree(4, &chunks);
            let mut found = Vec::new();
            let level = walk(&objects, root, 4, &mut found);
            let expected: Vec<_> = chunks.iter().map(|c| (c.row, c.address, u64::from(c.bytes))).collect();
            prop_assert_eq!(found, expected);
            let least = if chunks.len() > 4096 { 2 } else { u64::from(chunks.len() > 64) };
            prop_assert_eq!(level, least);
        }
    }
}
