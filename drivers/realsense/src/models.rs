//! The D400 models that depthrig drives, by their USB product numbers.
//!
//! Numbers, depth units and least firmware: librealsense `src/ds/d400/d400-private.h` and `d400-device.cpp`
//! (Apache-2.0).

use super::protocol::firmware::Firmware;

/// Intel's USB vendor number.
pub const VENDOR: u16 = 0x8086;

/// A model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Model {
    /// Its name, such as `D435`.
    pub name: &'static str,
    /// USB product number.
    pub product: u16,
    /// Whether colour has a module of its own; a D405 makes it from the stereo module.
    pub color_module: bool,
    /// Metres per unit of depth after power-on.
    pub depth_unit_m: f64,
    /// The oldest firmware whose answers are known.
    pub least_firmware: Firmware,
    /// Size of depth and infrared when none is asked for.
    pub depth_size: (u32, u32),
    /// Size of colour when none is asked for.
    pub color_size: (u32, u32),
    /// Whether it takes part in synchronisation by cable.
    pub sync: bool,
}

const fn model(name: &'static str, product: u16, least_firmware: [u8; 4]) -> Model {
    Model {
        name,
        product,
        color_module: true,
        depth_unit_m: 0.001,
        least_firmware: Firmware(least_firmware),
        depth_size: (848, 480),
        color_size: (1280, 720),
        sync: true,
    }
}

/// Every model.
pub const MODELS: [Model; 5] = [
    Model {
        color_module: false,
        depth_unit_m: 0.0001,
        color_size: (848, 480),
        sync: false,
        ..model("D405", 0x0B5B, [5, 12, 11, 8])
    },
    Model { depth_size: (1280, 720), ..model("D415", 0x0AD3, [5, 8, 15, 0]) },
    model("D435", 0x0B07, [5, 8, 15, 0]),
    model("D435i", 0x0B3A, [5, 12, 7, 100]),
    model("D455", 0x0B5C, [5, 13, 0, 50]),
];

/// Rates in the order in which they are taken when none is asked for. A dataset of 5 sets a second needs no more than
/// 15; auto-exposure reacts too slowly at 5 or 6.
pub const RATES_HZ: [f64; 4] = [15.0, 30.0, 10.0, 60.0];

/// Sizes in the order in which they are taken when the model's own is not offered (USB2).
pub const SIZES: [(u32, u32); 6] = [(848, 480), (640, 480), (1280, 720), (640, 360), (480, 270), (424, 240)];

/// The model of a product number.
pub fn of_product(product: u16) -> Option<&'static Model> {
    MODELS.iter().find(|m| m.product == product)
}

/// Why a D400 of this product number is not supported, and what to do about it.
pub const fn undriven(product: u16) -> Option<&'static str> {
    Some(match product {
        0x0ADB | 0x0ADC => {
            "it is in recovery mode: its firmware was lost; write it again with Intel's `rs-fw-update -r`, then plug it in anew"
        }
        0x0AD6 => {
            "it runs its emergency firmware for USB2; write its firmware again with Intel's `rs-fw-update`, then plug it in anew"
        }
        0x0AD1 | 0x0AD2 | 0x0AD4 | 0x0B03 | 0x0B4B | 0x1155 | 0x1156 | 0xABCD => {
            "it is a RealSense model that depthrig does not drive; D405, D415, D435, D435i and D455 it does"
        }
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn product_numbers_are_those_of_the_vendor() {
        let all: Vec<_> = MODELS.iter().map(|m| (m.name, m.product)).collect();
        let expected =
            [("D405", 0x0B5B), ("D415", 0x0AD3), ("D435", 0x0B07), ("D435i", 0x0B3A), ("D455", 0x0B5C)];
        assert_eq!(all, expected);
        assert!(MODELS.iter().all(|m| of_product(m.product) == Some(m) && undriven(m.product).is_none()));
    }

    #[test]
    fn a_d405_counts_tenths_of_millimetres() {
        let unit = |product| of_product(product).map(|m| m.depth_unit_m);
        assert_eq!(unit(0x0B5B), Some(0.0001));
        assert_eq!(unit(0x0B07), Some(0.001));
    }
}
