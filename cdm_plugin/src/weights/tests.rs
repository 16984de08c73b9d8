//! Files that the real `torch.save` wrote (`tests/data/torch/make.py`), and damaged ones.

use super::*;
use proptest::prelude::*;
use std::io::Write as _;
use std::path::PathBuf;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/torch").join(name)
}

fn open(name: &str) -> Weights {
    Weights::open(fixture(name)).unwrap()
}

fn refused(name: &str) -> String {
    let e = Weights::open(fixture(name)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadModel);
    assert!(e.to_string().starts_with(&fixture(name).display().to_string()), "{e}");
    e.to_string()
}

/// Names, shapes and first numbers.
fn contents(w: &Weights) -> Vec<(&str, Vec<usize>, Vec<f32>)> {
    w.entries().iter().map(|(n, e)| (n.as_str(), e.shape.clone(), w.to_f32(n).unwrap())).collect()
}

fn count(start: usize, n: usize) -> Vec<f32> {
    (start..start + n).map(|i| i as f32).collect()
}

/// A `.safetensors` file of 32-bit floats that count up from 1, and what else is in the head.
fn safetensors(tensors: &[(&str, &[usize])], more: &str) -> Vec<u8> {
    let mut head = Vec::new();
    let mut data = Vec::new();
    for (name, shape) in tensors {
        let from = data.len();
        for i in 0..shape.iter().product::<usize>() {
            data.extend_from_slice(&(i as f32 + 1.0).to_le_bytes());
        }
        head.push(format!(
            "\"{name}\":{{\"dtype\":\"F32\",\"shape\":{shape:?},\"data_offsets\":[{from},{}]}}",
            data.len()
        ));
    }
    let head = format!("{{{}{more}}}", head.join(","));
    [&(head.len() as u64).to_le_bytes()[..], head.as_bytes(), &data].concat()
}

fn open_bytes(bytes: &[u8]) -> Result<Weights> {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(bytes).unwrap();
    Weights::open(file.path())
}

#[test]
fn a_wrapped_checkpoint_is_read_with_and_without_the_prefix_of_a_wrapper() {
    let w = open("wrapped.pth");
    assert_eq!(
        contents(&w),
        [("head.bias", vec![2], count(20, 2)), ("head.weight", vec![2, 3], count(10, 6))]
    );
    assert_eq!((w.format(), w.others().len()), (Format::PyTorch, 0));
    let w = open("without_prefix.pth");
    assert_eq!(contents(&w), contents(&open("plain.pth")));
}

#[test]
fn plain_state_dicts_keep_their_names() {
    let expected = [
        ("head.bias", vec![3], count(20, 3)),
        ("head.weight", vec![2, 3], count(10, 6)),
        ("token", vec![1, 1, 4], count(30, 4)),
    ];
    for name in ["plain.pth", "parallel.pth", "protocol4.pth"] {
        assert_eq!(contents(&open(name)), expected, "{name}");
    }
    assert_eq!(contents(&open("parameters.pth")), [("p", vec![2, 2], count(5, 4))]);
}

#[test]
fn other_floats_are_converted_and_other_types_are_named() {
    let w = open("halves.pth");
    let expected =
        [("brain", vec![4], count(1, 4)), ("double", vec![2], count(1, 2)), ("half", vec![4], count(1, 4))];
    assert_eq!(contents(&w), expected);
    let others: Vec<_> = w.others().iter().map(|(n, what)| format!("{n}: {what}")).collect();
    assert_eq!(others, ["steps: a tensor of int64, shape []"]);
}

#[test]
fn views_of_one_storage_are_read_in_the_order_of_their_shape() {
    let w = open("views.pth");
    let expected = [
        ("empty", vec![0, 3], vec![]),
        ("one", vec![1, 1], vec![6.0]),
        ("rows", vec![2, 3], count(3, 6)),
        ("scalar", vec![], vec![2.5]),
        ("whole", vec![4, 3], count(0, 12)),
    ];
    assert_eq!(contents(&w), expected);
    let transposed = vec![0.0, 3.0, 1.0, 4.0, 2.0, 5.0];
    assert_eq!(contents(&open("not_contiguous.pth")), [("transposed", vec![3, 2], transposed)]);
}

#[test]
fn what_is_no_state_dict_is_refused_with_a_cure() {
    for (name, said) in [
        ("legacy.pth", "before 1.6"),
        ("no_weights.pth", "has no tensors at its top (it has \"state_dict\", \"epoch\")"),
        ("a_list.pth", "holds a list"),
        ("whole_module.pth", "names \"torch.nn.modules.linear.Linear\""),
    ] {
        let e = refused(name);
        assert!(e.contains(said), "{name}: {e}");
    }
    for (bytes, said) in [
        (&b""[..], "is empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n", "git lfs pull"),
        (b"<!DOCTYPE html><html></html>", "page of HTML"),
        (b"some words that are no weights at all", "neither a .safetensors file nor"),
        (b"PK\x03\x04 and then nothing that fits", "truncated"),
    ] {
        let e = open_bytes(bytes).unwrap_err();
        assert!(e.kind() == ErrorKind::BadModel && e.to_string().contains(said), "{e}");
    }
    let e = Weights::open("/nowhere/cdm.pth").unwrap_err();
    assert!(e.kind() == ErrorKind::NotFound && e.to_string().contains("there is no such file"), "{e}");
    let e = Weights::open(env!("CARGO_MANIFEST_DIR")).unwrap_err();
    assert!(e.kind() == ErrorKind::Io && e.to_string().contains("is a folder"), "{e}");
}

/// A pickle that would run a command if it were run.
#[test]
fn nothing_is_ever_run() {
    let e = pickle::read(b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00id\x85R.").unwrap_err();
    assert!(e.contains("names \"os.system\"") && e.contains("at byte 13"), "{e}");
    // By the other operation for names, and by one for objects.
    let e = pickle::read(b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x02id\x85R.").unwrap_err();
    assert!(e.contains("\"os.system\""), "{e}");
    for (op, program) in [
        ("'i'", &b"\x80\x02(ios\nsystem\n."[..]),
        ("'o'", b"\x80\x02(o."),
        ("0x92", b"\x80\x02N)}\x92."),
        ("0x82", b"\x80\x02\x82\x01."),
    ] {
        let e = pickle::read(program).unwrap_err();
        assert!(e.contains(&format!("operation {op}")), "{e}");
    }
}

#[test]
fn a_pickle_can_neither_nest_the_stack_away_nor_grow_without_end() {
    let deep = [&b"\x80\x02)"[..], &vec![0x85; 1 << 20], b"."].concat();
    assert_eq!(pickle::read(&deep).unwrap().values.len(), (1 << 20) + 1);
    // A list that holds itself.
    assert!(pickle::read(b"\x80\x02]q\x00h\x00a.").is_ok());
    let many = [&b"\x80\x02"[..], &vec![b'N'; (4 << 20) + 1], b"."].concat();
    assert!(pickle::read(&many).unwrap_err().contains("more than 4194304 values"));
    let again = [&b"\x80\x02Nq\x00"[..], &b"h\x00".repeat((4 << 20) + 1), b"."].concat();
    assert!(pickle::read(&again).unwrap_err().contains("holds more than"));
    let lengths = pickle::read(b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\xff.").unwrap_err();
    assert!(lengths.contains("beyond its end"), "{lengths}");
    assert!(pickle::read(&vec![b'N'; pickle::MAX_BYTES + 1]).is_err());
}

#[test]
fn safetensors_are_read_and_a_wrong_size_is_reported() {
    let whole = safetensors(&[("module.a", &[2, 2]), ("module.b", &[3])], ",\"__metadata__\":{\"k\":\"v\"}");
    let w = open_bytes(&whole).unwrap();
    assert_eq!(contents(&w), [("a", vec![2, 2], count(1, 4)), ("b", vec![3], count(1, 3))]);
    assert_eq!((w.format(), w.metadata()["k"].as_str()), (Format::Safetensors, "v"));
    // One name without the prefix: then it is none.
    let w = open_bytes(&safetensors(&[("module.a", &[1]), ("b", &[1])], "")).unwrap();
    assert_eq!(w.entries().keys().collect::<Vec<_>>(), ["b", "module.a"]);
    let e = open_bytes(&whole[..whole.len() - 5]).unwrap_err().to_string();
    let sizes =
        format!("is cut short: it has {} bytes, and the whole takes {}", whole.len() - 5, whole.len());
    assert!(e.contains(&sizes), "{e}");
    let e = open_bytes(&whole[..50]).unwrap_err().to_string();
    assert!(e.contains("cut short: it has 50 bytes, and the head alone takes"), "{e}");
    let e = open_bytes(&[&whole[..], b"x"].concat()).unwrap_err().to_string();
    assert!(e.contains("its head describes"), "{e}");
}

#[test]
fn a_checkpoint_cut_anywhere_is_an_error() {
    let whole = std::fs::read(fixture("wrapped.pth")).unwrap();
    for len in 0..whole.len() {
        assert!(parse(&&whole[..len]).is_err(), "{len} of {} bytes", whole.len());
    }
}

/// Reads whatever it is, and uses what comes out.
fn survive(bytes: &[u8]) -> bool {
    fuzzing::file(bytes) > 0
}

proptest! {
    #[test]
    fn damaged_files_end_in_errors(
        file in 0_usize..8,
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        const FILES: [&str; 7] =
            ["wrapped.pth", "plain.pth", "halves.pth", "views.pth", "protocol4.pth", "no_weights.pth", "whole_module.pth"];
        let mut bytes = match FILES.get(file) {
            Some(name) => std::fs::read(fixture(name)).unwrap(),
            None => safetensors(&[("a", &[2, 2]), ("b", &[3])], ""),
        };
        for (at, to) in changes {
            let at = at.index(bytes.len());
            bytes[at] = to;
        }
        let _ = survive(&bytes);
    }

    #[test]
    fn damaged_pickles_end_in_errors(changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8)) {
        let zip = std::fs::read(fixture("wrapped.pth")).unwrap();
        let start = zip.windows(2).position(|w| w == b"\x80\x02").unwrap();
        let mut bytes = zip[start..start + 1500].to_vec();
        for (at, to) in changes {
            let at = at.index(bytes.len());
            bytes[at] = to;
        }
        drop(pickle::read(&bytes));
    }
}
