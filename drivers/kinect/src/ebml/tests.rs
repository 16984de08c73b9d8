//! Elements and laces against bytes written by hand, some of them out of the standard.

use super::*;
use proptest::prelude::*;

fn frames(body: &[u8]) -> Option<Vec<Vec<u8>>> {
    Some(block(body)?.frames()?.map(<[u8]>::to_vec).collect())
}

#[test]
fn heads_have_identifier_and_size() {
    assert_eq!(head(&[0x1A, 0x45, 0xDF, 0xA3, 0xA3]), Some(Head { id: id::EBML, len: 5, size: Some(0x23) }));
    assert_eq!(head(&[0xEC, 0x43, 0xD5]), Some(Head { id: id::VOID, len: 3, size: Some(0x3D5) }));
    let unknown = [0x1F, 0x43, 0xB6, 0x75, 0x01, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF];
    assert_eq!(head(&unknown), Some(Head { id: id::CLUSTER, len: 12, size: None }));
    assert_eq!(head(&unknown[..11]), None, "cut off");
    assert_eq!(head(&[0xEC, 0xFF]).unwrap().size, None);
    assert_eq!(head(&[0x08, 0, 0, 0, 0, 0x80]), None, "no identifier has five bytes");
    assert_eq!(head(&[0xEC, 0x00, 0, 0, 0, 0, 0, 0, 0, 0]), None, "no size has nine bytes");
}

#[test]
fn children_end_at_an_incomplete_one() {
    let body = [0xEC, 0x82, 1, 2, 0xD7, 0x81, 9, 0x86, 0x84, b'a', b'b'];
    let mut found = children(&body);
    assert_eq!(found.next(), Some((id::VOID, &[1, 2][..])));
    assert_eq!(found.next(), Some((id::TRACK_NUMBER, &[9][..])));
    assert!(found.is_complete());
    assert_eq!((found.next(), found.is_complete(), found.next()), (None, false, None));
    assert_eq!(child_uint(&body, id::TRACK_NUMBER), Some(9));
    assert_eq!(child(&body, id::CODEC_ID), None);
}

#[test]
fn numbers_and_text() {
    assert_eq!((uint(&[]), uint(&[1, 0]), uint(&[0; 9])), (Some(0), Some(256), None));
    assert_eq!(float(&[0x48, 0xE2, 0x89, 0x20]), Some(463_945.0));
    assert_eq!(float(&1e9_f64.to_be_bytes()), Some(1e9));
    assert_eq!(float(&[0; 3]), None);
    assert_eq!(text(b"COLOR\0junk"), "COLOR");
}

#[test]
fn a_block_without_laces_is_one_frame() {
    let b = block(&[0x81, 0xFF, 0xFE, 0x80, 7, 8]).unwrap();
    assert_eq!((b.track, b.time), (1, -2));
    assert_eq!(frames(&[0x81, 0xFF, 0xFE, 0x80, 7, 8]), Some(vec![vec![7, 8]]));
    assert_eq!(frames(&[0x81, 0, 0, 0]), Some(vec![vec![]]), "an empty frame is one");
    assert_eq!(block(&[0x81, 0, 0]), None);
}

/// The example of RFC 9559, section 10.3: frames of 800, 500 and 1000 bytes.
fn example(flags: u8, sizes: &[u8]) -> Vec<u8> {
    let data = [vec![1; 800], vec![2; 500], vec![3; 1000]].concat();
    [&[0x84, 0, 0, flags, 2][..], sizes, &data].concat()
}

#[test]
fn laces_of_the_standard_come_apart() {
    let lengths = |body: &[u8]| frames(body).map(|f| f.iter().map(Vec::len).collect::<Vec<_>>());
    assert_eq!(lengths(&example(0x02, &[255, 255, 255, 35, 255, 245])), Some(vec![800, 500, 1000]), "Xiph");
    assert_eq!(lengths(&example(0x06, &[0x43, 0x20, 0x5E, 0xD3])), Some(vec![800, 500, 1000]), "EBML");
    let parts = frames(&example(0x06, &[0x43, 0x20, 0x5E, 0xD3])).unwrap();
    assert!(parts.iter().zip(1..).all(|(part, n)| part.iter().all(|b| *b == n)));
    let fixed = [&[0x84, 0, 0, 0x04, 2][..], &[5; 120]].concat();
    assert_eq!(lengths(&fixed), Some(vec![40, 40, 40]), "fixed");
    assert_eq!(lengths(&fixed[..124]), None, "119 bytes are not three frames");
    assert_eq!(lengths(&[0x84, 0, 0, 0x02, 0, 1, 2, 3]), Some(vec![3]), "a lace of one");
}

#[test]
fn laces_that_claim_more_than_there_is_are_refused() {
    assert_eq!(frames(&example(0x02, &[255, 255, 255, 35, 255, 245])[..1000]), None);
    assert_eq!(frames(&[0x84, 0, 0, 0x06, 2, 0x40]), None, "the sizes are cut off");
    assert_eq!(frames(&[0x84, 0, 0, 0x06, 2, 0x81, 0x80, 0, 0]), None, "1 less 63 bytes");
    assert_eq!(frames(&[0x84, 0, 0, 0x06]), None, "no count");
}

proptest! {
    #[test]
    fn whatever_the_bytes_frames_lie_within_them(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let mut inside = 0;
        for (_, body) in children(&bytes) {
            inside += body.len();
        }
        prop_assert!(inside <= bytes.len());
        if let Some(parts) = block(&bytes).and_then(|b| b.frames()) {
            let count = parts.clone().count();
            prop_assert!(parts.map(<[u8]>::len).sum::<usize>() <= bytes.len());
            prop_assert!(count <= 256);
        }
    }

    #[test]
    fn laces_that_are_written_are_read(sizes in proptest::collection::vec(0usize..700, 1..20)) {
        let parts: Vec<Vec<u8>> = sizes.iter().enumerate().map(|(i, n)| vec![i as u8; *n]).collect();
        let mut body = vec![0x84, 0, 0, 0x02, parts.len() as u8 - 1];
        for part in &parts[..parts.len() - 1] {
            body.extend(vec![255; part.len() / 255]);
            body.push((part.len() % 255) as u8);
        }
        body.extend(parts.concat());
        prop_assert_eq!(frames(&body), Some(parts));
    }
}
