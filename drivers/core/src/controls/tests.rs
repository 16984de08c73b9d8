//! Values that controls accept, against a plain model; and the messages that list them.

use super::*;
use proptest::prelude::*;

fn control(kind: ControlKind, minimum: i64, maximum: i64, step: u64) -> Control {
    Control {
        id: 1,
        name: "gain".to_owned(),
        kind,
        minimum,
        maximum,
        step,
        default: minimum,
        read_only: false,
        write_only: false,
        inactive: false,
        items: Vec::new(),
    }
}

fn menu() -> Control {
    let items = vec![(0, "Manual Mode".to_owned()), (2, "50 Hz".to_owned()), (3, "Auto".to_owned())];
    Control { items, ..control(ControlKind::Menu, 0, 3, 1) }
}

#[test]
fn names_are_those_of_v4l2_ctl() {
    assert_eq!(plain_name("White Balance, Automatic"), "white_balance_automatic");
    assert_eq!(plain_name("  Gain (R) "), "gain_r");
    assert_eq!(plain_name("power_line_frequency"), "power_line_frequency");
    assert_eq!(plain_name(""), "");
}

#[test]
fn an_unknown_name_lists_those_there_are() {
    let controls = [control(ControlKind::Integer, 0, 1, 1), Control { name: "hue".into(), ..menu() }];
    assert_eq!(find(&controls, "Gain").unwrap().name, "gain");
    let e = find(&controls, "gian").unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert_eq!(e.to_string(), "unknown control \"gian\"; it has: gain, hue");
    assert!(find(&[], "x").unwrap_err().to_string().ends_with("it has none"));
}

#[test]
fn a_refusal_says_what_the_control_takes() {
    let e = control(ControlKind::Integer, 10, 100, 10).check(&ControlValue::Integer(15)).unwrap_err();
    assert_eq!(
        e.to_string(),
        "control gain cannot be 15: it takes 10 to 100 in steps of 10 from 10, 10 after power-on"
    );
    let e = menu().check(&ControlValue::Item("60 Hz".into())).unwrap_err().to_string();
    assert!(e.ends_with("it takes one of: 0 \"Manual Mode\", 2 \"50 Hz\", 3 \"Auto\""), "{e}");
    let read_only = Control { read_only: true, ..menu() };
    assert!(
        read_only.check(&ControlValue::Integer(0)).unwrap_err().to_string().ends_with("can only be read")
    );
    let wide = control(ControlKind::Integer, 0, 255, 1).check(&ControlValue::Boolean(true)).unwrap_err();
    assert!(wide.to_string().ends_with("takes 0 to 255, 0 after power-on"), "{wide}");
}

#[test]
fn menus_take_their_items_by_number_or_name() {
    let check = |v: ControlValue| menu().check(&v).ok();
    assert_eq!(check(ControlValue::Item("50 Hz".into())), Some(2));
    assert_eq!(check(ControlValue::Item("manual_mode".into())), Some(0));
    assert_eq!(check(ControlValue::Integer(3)), Some(3));
    assert_eq!(check(ControlValue::Integer(1)), None, "within the range, but there is no such item");
    assert_eq!(check(ControlValue::Boolean(true)), None);
}

#[test]
fn switches_and_bits() {
    let switch = control(ControlKind::Boolean, 0, 1, 1);
    assert_eq!(switch.check(&ControlValue::Boolean(true)).unwrap(), 1);
    assert_eq!(switch.check(&ControlValue::Integer(0)).unwrap(), 0);
    assert!(switch.check(&ControlValue::Integer(2)).is_err());
    let bits = control(ControlKind::Bitmask, 0, 0b1010, 0);
    assert_eq!(bits.check(&ControlValue::Integer(0b1000)).unwrap(), 0b1000);
    assert!(
        bits.check(&ControlValue::Integer(0b1)).is_err() && bits.check(&ControlValue::Integer(-8)).is_err()
    );
}

#[test]
fn values_from_text() {
    let value = |s: &str| s.parse::<ControlValue>().unwrap();
    assert_eq!(value("-3"), ControlValue::Integer(-3));
    assert_eq!(value("true"), ControlValue::Boolean(true));
    assert_eq!(value("50 Hz"), ControlValue::Item("50 Hz".into()));
}

proptest! {
    #[test]
    fn a_number_is_taken_when_it_is_in_the_list_of_all_values(
        minimum in -50i64..50, span in 0i64..100, step in 0u64..13, value in -120i64..170,
    ) {
        let c = control(ControlKind::Integer, minimum, minimum + span, step);
        let mut all = Vec::new();
        let mut v = minimum;
        while v <= minimum + span {
            all.push(v);
            v += step.max(1) as i64;
        }
        prop_assert_eq!(c.check(&ControlValue::Integer(value)).is_ok(), all.contains(&value));
    }

    #[test]
    fn no_range_of_a_device_makes_it_panic(minimum: i64, maximum: i64, step: u64, value: i64) {
        for kind in [ControlKind::Integer64, ControlKind::Bitmask, ControlKind::Boolean] {
            let _ = control(kind, minimum, maximum, step).check(&ControlValue::Integer(value));
        }
    }
}
