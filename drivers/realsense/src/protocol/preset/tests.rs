use super::*;
use crate::protocol::fake;
use proptest::prelude::*;

const GOOD: &str = r#"{
    "name": "near",
    "groups": { "amplitude_factor": [0.08], "depth_table": [100, 0, 65535, 0, -3], "census_radius": [9, 4294967295] }
}"#;

#[test]
fn a_file_becomes_groups_of_bytes_in_their_order() {
    let preset = Preset::parse(GOOD).unwrap();
    assert_eq!(preset.name, "near");
    let depth = vec![100, 0, 0, 0, 0, 0, 0, 0, 0xFF, 0xFF, 0, 0, 0, 0, 0, 0, 0xFD, 0xFF, 0xFF, 0xFF];
    let groups = [
        (Group::DepthTable, depth),
        (Group::CensusRadius, vec![9, 0, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF]),
        (Group::AmplitudeFactor, 0.08f32.to_le_bytes().to_vec()),
    ];
    assert_eq!(preset.groups, groups);
}

#[test]
fn what_is_wrong_is_said() {
    for (text, says) in [
        ("", "cannot be read"),
        ("{}", "groups"),
        (r#"{"groups": {"depth": [1]}}"#, "depth_table"),
        (r#"{"groups": {"depth_table": [1, 2]}}"#, "has 2 values; the camera has 5"),
        (r#"{"groups": {"ae_control": [4294967296]}}"#, "32 bits"),
        (r#"{"groups": {"ae_control": [-2147483649]}}"#, "32 bits"),
        (r#"{"groups": {"ae_control": [18446744073709551615]}}"#, "32 bits"),
        (r#"{"groups": {"ae_control": [1e300]}}"#, "32 bits"),
        (r#"{"groups": {"ae_control": ["1"]}}"#, "cannot be read"),
        (r#"{"groups": {}, "param": 1}"#, "param"),
    ] {
        let e = Preset::parse(text).unwrap_err();
        assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains(says), "{text}: {e}");
    }
    let long = format!(r#"{{"name": "{}", "groups": {{}}}}"#, "x".repeat(MAX_FILE));
    assert!(Preset::parse(&long).unwrap_err().to_string().contains("65536"));
}

#[test]
fn what_was_written_is_returned_with_what_was_there() {
    let preset = Preset::parse(GOOD).unwrap();
    let written = preset.write(&mut fake::advanced(true)).unwrap();
    let groups: Vec<_> = written.iter().map(|w| w.group).collect();
    assert_eq!(groups, [Group::DepthTable, Group::CensusRadius, Group::AmplitudeFactor]);
    assert_eq!(written[0].before[..4], 1000u32.to_le_bytes());
    assert_eq!(written[1].before, [11; 8]);
    for (w, (_, bytes)) in written.iter().zip(&preset.groups) {
        assert_eq!(w.after, *bytes);
    }
    let e = preset.write(&mut fake::advanced(false)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Unsupported);
    assert_eq!(Preset::default().write(&mut fake::advanced(false)).unwrap(), []);
}

#[test]
fn a_group_that_is_refused_is_named() {
    let preset = Preset { name: "p".into(), groups: vec![(Group::Rsm, vec![0; 8])] };
    let e = preset.write(&mut fake::advanced(true)).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("\"p\", group rsm"), "{e}");
}

proptest! {
    #[test]
    fn any_text(text in ".{0,200}") {
        let _ = Preset::parse(&text);
    }

    #[test]
    fn every_value_becomes_its_bits(v in any::<u32>(), i in i32::MIN..0, x in any::<f32>().prop_filter("", |x| x.is_finite())) {
        let text = format!(r#"{{"groups": {{"hdad": [{v}, {i}, {x:?}]}}}}"#);
        let bytes = &Preset::parse(&text).unwrap().groups[0].1;
        prop_assert_eq!(&bytes[..4], &v.to_le_bytes());
        prop_assert_eq!(&bytes[4..8], &i.to_le_bytes());
        prop_assert_eq!(&bytes[8..], &x.to_le_bytes());
    }
}
