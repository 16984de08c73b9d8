//! Settings reach the camera, in order, or are refused with what it takes.

use super::*;
use crate::config::Emitter;
use depthrig_usb::controls::ControlKind;
use std::collections::BTreeMap;

/// An extension unit with the controls of a D435.
#[derive(Default)]
struct Unit {
    values: BTreeMap<u8, u32>,
    order: Vec<u8>,
    busy: u32,
    /// Keeps what it has, whatever it is given.
    stubborn: bool,
}

impl ControlPort for Unit {
    fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()> {
        assert_eq!(unit, 3);
        if self.busy > 0 {
            self.busy -= 1;
            return Err(Error::new(ErrorKind::Busy, "not now"));
        }
        let (length, least, most, step) = match selector {
            2 => (1, 0, 2, 1),
            3 => (4, 1, 165_000, 1),
            4 => (2, 0, 360, 30),
            0x0B => (1, 0, 1, 1),
            _ => return Err(Error::new(ErrorKind::Unsupported, "no such selector")),
        };
        let number: u32 = match query {
            Query::GetLen => {
                data.copy_from_slice(&(length as u16).to_le_bytes());
                return Ok(());
            }
            Query::SetCur => {
                assert_eq!(data.len(), length, "selector {selector}");
                let mut bytes = [0; 4];
                bytes[..length].copy_from_slice(data);
                if !self.stubborn {
                    self.values.insert(selector, u32::from_le_bytes(bytes));
                }
                self.order.push(selector);
                return Ok(());
            }
            Query::GetMin => least,
            Query::GetMax => most,
            Query::GetRes => step,
            _ => self.values.get(&selector).copied().unwrap_or(0),
        };
        data.copy_from_slice(&number.to_le_bytes()[..length]);
        Ok(())
    }
}

/// Image controls in memory.
#[derive(Default)]
struct Image {
    values: BTreeMap<String, i64>,
    order: Vec<String>,
}

impl ImageControls for Image {
    fn list(&mut self) -> Result<Vec<Control>> {
        let control = |name: &str, maximum| Control {
            id: 1,
            name: name.to_owned(),
            kind: if maximum == 1 { ControlKind::Boolean } else { ControlKind::Integer },
            minimum: if maximum == 1 { 0 } else { 16 },
            maximum,
            step: 1,
            default: 16,
            read_only: false,
            write_only: false,
            inactive: false,
            items: Vec::new(),
        };
        Ok(vec![
            control("gain", 248),
            control("white_balance_automatic", 1),
            control("white_balance_temperature", 6500),
        ])
    }

    fn get(&mut self, control: &Control) -> Result<i64> {
        Ok(self.values.get(&control.name).copied().unwrap_or(0))
    }

    fn set(&mut self, control: &Control, value: i64) -> Result<()> {
        self.values.insert(control.name.clone(), value);
        self.order.push(control.name.clone());
        Ok(())
    }
}

fn apply_to(config: &RealsenseConfig, unit: &mut Unit, color: &mut Image) -> Result<Image> {
    let mut stereo = Image::default();
    apply(config, "D435 1", unit, Some(&mut stereo), Some(color))?;
    Ok(stereo)
}

#[test]
fn exposure_by_hand_turns_the_automatic_off_first() {
    let config = RealsenseConfig {
        exposure_us: Some(8500),
        gain: Some(64),
        emitter: Some(Emitter::Laser),
        laser_power_mw: Some(150),
        ..RealsenseConfig::default()
    };
    let mut unit = Unit { busy: 2, ..Unit::default() };
    let mut color = Image::default();
    let stereo = apply_to(&config, &mut unit, &mut color).unwrap();
    assert_eq!(unit.order, [0x0B, 3, 2, 4]);
    assert_eq!(unit.values, [(0x0B, 0), (3, 8500), (2, 1), (4, 150)].into());
    assert_eq!(stereo.values, [("gain".to_owned(), 64)].into());
    assert!(color.order.is_empty());
}

#[test]
fn what_is_not_asked_for_is_not_touched() {
    let mut unit = Unit::default();
    apply_to(&RealsenseConfig::default(), &mut unit, &mut Image::default()).unwrap();
    assert!(unit.order.is_empty());
}

#[test]
fn a_value_that_the_camera_does_not_take_names_what_it_does() {
    let refused = |config: RealsenseConfig| {
        let mut unit = Unit::default();
        let e = apply_to(&config, &mut unit, &mut Image::default()).err().unwrap();
        assert_eq!(e.kind(), ErrorKind::BadInput);
        assert!(!unit.order.contains(&4), "it was not sent");
        e.to_string()
    };
    let laser = |mw| RealsenseConfig { laser_power_mw: Some(mw), ..RealsenseConfig::default() };
    let text = "laser_power_mw = 170: the camera takes 0 to 360 mW in steps of 30";
    assert_eq!(refused(laser(170)), text);
    assert!(refused(laser(390)).contains("0 to 360"));
    let led = RealsenseConfig { emitter: Some(Emitter::Led), ..RealsenseConfig::default() };
    assert!(refused(led).contains("emitter = 3: the camera takes 0 to 2"));
    let gain = RealsenseConfig { gain: Some(300), ..RealsenseConfig::default() };
    assert!(refused(gain).contains("gain"));
}

#[test]
fn a_camera_that_keeps_another_value_is_found_out() {
    let config = RealsenseConfig { laser_power_mw: Some(150), ..RealsenseConfig::default() };
    let mut unit = Unit { stubborn: true, ..Unit::default() };
    let e = apply_to(&config, &mut unit, &mut Image::default()).err().unwrap();
    assert_eq!(e.kind(), ErrorKind::Protocol);
    assert!(e.to_string().contains("set to 150 and the camera reports 0"), "{e}");
}

#[test]
fn automatics_of_colour_are_set_before_what_they_hold() {
    let values = [
        ("white_balance_temperature".to_owned(), ControlValue::Integer(4600)),
        ("white_balance_automatic".to_owned(), ControlValue::Boolean(false)),
    ];
    let config = RealsenseConfig { color_controls: values.into(), ..RealsenseConfig::default() };
    let mut color = Image::default();
    apply_to(&config, &mut Unit::default(), &mut color).unwrap();
    assert_eq!(color.order, ["white_balance_automatic", "white_balance_temperature"]);
    assert_eq!(color.values["white_balance_temperature"], 4600);
    let unknown = [("sharpnes".to_owned(), ControlValue::Integer(1))];
    let config = RealsenseConfig { color_controls: unknown.into(), ..RealsenseConfig::default() };
    let e = apply_to(&config, &mut Unit::default(), &mut Image::default()).err().unwrap();
    assert!(e.to_string().contains("unknown control \"sharpnes\"; it has: gain"), "{e}");
}

#[test]
fn a_camera_that_stays_busy_is_not_asked_for_ever() {
    let config = RealsenseConfig { laser_power_mw: Some(150), ..RealsenseConfig::default() };
    let mut unit = Unit { busy: u32::MAX, ..Unit::default() };
    let e = apply_to(&config, &mut unit, &mut Image::default()).err().unwrap();
    assert_eq!((e.kind(), u32::MAX - unit.busy), (ErrorKind::Busy, TRIES));
}
