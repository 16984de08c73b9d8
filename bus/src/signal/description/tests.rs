//! Descriptions round-trip, and invalid ones are refused with the rule that they break.

use super::*;

fn name() -> SignalName {
    "arm/state".parse().unwrap()
}

fn field(name: &str, kind: FieldType) -> SignalField {
    SignalField::new(name, kind, "")
}

#[test]
fn the_json_is_compact_and_reads_back() {
    let arm = SignalDescription::joints(name(), &["shoulder", "elbow"], "rad").unwrap();
    assert_eq!(
        arm.json(),
        r#"{"version":1,"name":"arm/state","kind":"joints","fields":[{"name":"shoulder","type":"f64","unit":"rad"},{"name":"elbow","type":"f64","unit":"rad"}]}"#
    );
    let pose = SignalDescription::pose(name(), "base").unwrap();
    let mixed = SignalDescription::fields(
        name(),
        vec![
            SignalField::new("ü \"quoted\" 🦾", FieldType::Bool, "µ").with_count(3),
            field("n", FieldType::I64),
            field("note", FieldType::Text),
        ],
    )
    .unwrap();
    for description in [arm, pose, mixed] {
        let read = SignalDescription::parse(description.json().as_bytes()).unwrap();
        assert_eq!(read, description);
        assert_eq!((read.hash(), read.json()), (description.hash(), description.json()));
        assert_eq!(read.value_bytes(), description.value_bytes());
    }
}

#[test]
fn each_value_lies_at_a_multiple_of_its_size() {
    let kinds =
        [FieldType::Bool, FieldType::F32, FieldType::Bool, FieldType::F64, FieldType::Bool, FieldType::Text];
    let fields = kinds.iter().enumerate().map(|(i, kind)| field(&format!("f{i}"), *kind)).collect();
    let description = SignalDescription::fields(name(), fields).unwrap();
    let offsets: Vec<_> = (0..kinds.len()).map(|i| description.offset(i).unwrap()).collect();
    assert_eq!(offsets, [0, 4, 8, 16, 24, 28]);
    assert_eq!(description.value_bytes(), 32..MAX_VALUES_BYTES + 1);
}

/// The published test value of FNV-1a.
#[test]
fn the_hash_is_fnv_1a() {
    assert_eq!(hash(b"foobar"), 0x8594_4171_F739_67E8);
}

#[test]
fn a_broken_rule_is_named() {
    use FieldType::{F64, I64, Text};
    let refused = |fields: Vec<SignalField>, why: &str| {
        let e = SignalDescription::fields(name(), fields).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::Invalid);
        assert!(e.to_string().contains("signal arm/state") && e.to_string().contains(why), "{e}");
    };
    refused(vec![], "has no fields");
    refused(vec![field("", F64)], "field 0");
    refused(vec![field("a\nb", F64)], "control characters");
    refused(vec![field("a", F64), field("a", I64)], "two fields are named \"a\"");
    refused(vec![field("a", F64).with_count(0)], "has no elements");
    refused(vec![field("a", Text), field("b", F64)], "at the end");
    refused(vec![field("a", Text).with_count(2)], "not one text");
    refused(vec![SignalField::new("a", F64, "u".repeat(33))], "unit of field \"a\"");
    refused(vec![field("a", F64).with_count(513)], "more than 4096 bytes");
    refused(vec![field("a", F64).with_count(u32::MAX)], "more than 4096 bytes");
    refused(
        (0..99).map(|i| field(&format!("field_number_{i:020}"), FieldType::Bool)).collect(),
        "4096 is the most",
    );
    assert!(SignalDescription::joints(name(), &[], "rad").is_err());
    assert!(SignalDescription::pose(name(), "").unwrap_err().to_string().contains("frame"));
}

#[test]
fn json_that_breaks_a_rule_is_refused() {
    let refused = |json: &str, kind: ErrorKind, why: &str| {
        let e = SignalDescription::parse(json.as_bytes()).unwrap_err();
        assert!(e.kind() == kind && e.to_string().contains(why), "{json}: {e}");
    };
    refused("{", ErrorKind::Invalid, "EOF");
    let json = |kind: &str, fields: &str| {
        format!(r#"{{"version":1,"name":"a/b","kind":"{kind}","frame":"","fields":[{fields}]}}"#)
    };
    let x = r#"{"name":"x","type":"f64"}"#;
    assert!(SignalDescription::parse(json("fields", x).as_bytes()).is_ok());
    assert!(SignalDescription::parse(json("fields", x).replace('}', r#","later":1}"#).as_bytes()).is_ok());
    refused(
        &json("fields", x).replace("\"version\":1", "\"version\":2"),
        ErrorKind::VersionMismatch,
        "version 2",
    );
    refused(&json("speech", x), ErrorKind::Invalid, "speech");
    refused(&json("pose", x), ErrorKind::Invalid, "translation_m");
    refused(&json("joints", r#"{"name":"x","type":"i64"}"#), ErrorKind::Invalid, "not one float");
    refused(&json("fields", x).replace("a/b", "A/b"), ErrorKind::Invalid, "begins with 'A'");
    refused(
        &json("fields", x).replace(r#""frame":"""#, r#""frame":"base""#),
        ErrorKind::Invalid,
        "not a pose",
    );
    let e = SignalDescription::parse(b"\xff").unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Invalid);
}
