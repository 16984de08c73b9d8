//! Entry points of the fuzz targets of data from a RealSense camera.

use crate::protocol::gvd::{Gvd, L515Gvd};
use crate::protocol::hwm::{
    Code, D4xxOpcode, HardwareMonitor, L515Opcode, Received, Request, build_refusal, build_reply,
    build_unit_frame, reply_data, unit_reply,
};
use crate::protocol::imu::ImuCalibration;
use crate::protocol::intrinsics;
use crate::protocol::l515::{ColorExtrinsics, ColorIntrinsics, Control, DepthIntrinsics, Temperatures};
use crate::protocol::metadata::{Metadata, RecordFormat, records};
use crate::protocol::preset::Preset;
use crate::protocol::sync::SyncMode;
use crate::protocol::tables::{self, Coefficients, Header, RectifiedItem, RgbTable};
use crate::protocol::{advanced, health};
use depthrig_bus::{Intrinsics, Pose};
use depthrig_driver::Result;
use depthrig_driver::bytes::put;

/// Sizes that intrinsics are asked for: one by each rule, and two that nobody has.
const SIZES: [(u32, u32); 8] =
    [(1280, 720), (640, 480), (848, 480), (848, 100), (256, 144), (960, 540), (1, 1), (u32::MAX, u32::MAX)];

/// A camera that answers every request with the same data.
struct FixedReply<'a>(&'a [u8]);

impl HardwareMonitor for FixedReply<'_> {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        let reply = build_reply(request.opcode(), self.0);
        let frame = build_unit_frame(reply.get(..1020).unwrap_or(&reply))?;
        reply_data(request, unit_reply(&frame)?).map(<[u8]>::to_vec)
    }
}

fn finite(values: &[f64]) -> bool {
    values.iter().all(|v| v.is_finite())
}

fn good(i: &Intrinsics) -> bool {
    finite(&[i.fx, i.fy, i.cx, i.cy]) && finite(&i.coeffs) && i.fx > 0.0 && i.fy > 0.0
}

fn good_pose(p: &Pose) -> bool {
    let length = p.rotation_xyzw.iter().map(|v| v * v).sum::<f64>();
    finite(&p.translation_m) && (length - 1.0).abs() < 1e-6
}

/// A reply of the hardware monitor, as it comes from the extension unit and from the bulk endpoint; how many of these
/// two are replies to something.
///
/// # Panics
/// When a reply that is taken is not built the same again.
pub fn hwm(bytes: &[u8]) -> u64 {
    let mut frame = [0; 1024];
    put(&mut frame, 0, bytes.get(..1024).unwrap_or(bytes));
    let mut came = 0;
    for reply in [Some(bytes), unit_reply(&frame).ok(), unit_reply(bytes).ok()].into_iter().flatten() {
        for request in
            [Request::device_info(), Request::clock(), Request::calibration_table(25), Request::sync()]
        {
            match reply_data(&request, reply) {
                Ok(data) => {
                    assert_eq!(build_reply(request.opcode(), data), reply);
                    came += 1;
                }
                Err(e) => assert!(!e.to_string().is_empty()),
            }
        }
    }
    // A device's own view: requests that it may get from anybody.
    if let Ok(received) = Received::parse(bytes) {
        assert!(received.data.len() <= 1000);
        let _ = (D4xxOpcode::from_code(received.opcode), L515Opcode::from_code(received.opcode));
        assert_eq!(build_refusal(Code(-1)).len(), 4);
        came += 1;
    }
    // Everything that asks once and makes sense of the data.
    let mut monitor = FixedReply(bytes);
    let _ =
        (SyncMode::read(&mut monitor), health::temperature_c(&mut monitor), advanced::is_on(&mut monitor));
    if let Ok((unit, _)) = advanced::depth_unit_m(&mut monitor, 0x0B07) {
        assert!(unit > 0.0 && unit <= 1.0);
    }
    let _ = advanced::set_depth_unit_m(&mut monitor, 0.001);
    came
}

/// A camera's description of itself; returns how many families accept it.
///
/// # Panics
/// When an account changes by being built and read.
pub fn gvd(bytes: &[u8]) -> u64 {
    let d400 = Gvd::parse(bytes).ok().map(|gvd| assert_eq!(Gvd::parse(&gvd.build()).ok(), Some(gvd)));
    let l515 = L515Gvd::parse(bytes).ok().map(|gvd| assert_eq!(L515Gvd::parse(&gvd.build()).ok(), Some(gvd)));
    u64::from(d400.is_some()) + u64::from(l515.is_some())
}

/// A calibration table of a D400, used at every kind of size. Of an odd number of bytes it gets its checksum put right,
/// without which nearly nothing is read. Returns how many results came of it.
///
/// # Panics
/// When intrinsics or a pose that are returned are not finite, or a table changes by being built and read.
pub fn tables(bytes: &[u8]) -> u64 {
    let mut table = bytes.to_vec();
    if let (1, Some(payload)) = (bytes.len() % 2, bytes.get(tables::HEADER..)) {
        put(&mut table, 12, &crc32fast::hash(payload).to_le_bytes());
    }
    let mut came = 0;
    let _ = (Header::open(&table, tables::COEFFICIENTS), Header::open(&table, tables::RGB));
    if let Ok(c) = Coefficients::parse(&table) {
        let items = RectifiedItem::parse_all(table.get(512..).unwrap_or_default());
        for (w, h) in SIZES {
            for items in [&items[..], &[]] {
                if let Ok((i, _)) = intrinsics::depth(&c, items, w, h) {
                    assert!(good(&i), "{i:?}");
                    came += 1;
                }
            }
        }
        came += u64::from(intrinsics::right_in_depth(&c).is_ok_and(|p| {
            assert!(good_pose(&p));
            true
        }));
        let again = Coefficients::parse(&c.build()).map(|c| c.build());
        assert_eq!(again.ok(), Some(c.build()));
    }
    if let Ok(t) = RgbTable::parse(&table) {
        for (w, h) in SIZES {
            for i in [intrinsics::color(&t, w, h), intrinsics::d405_color(&t, w, h)].into_iter().flatten() {
                assert!(good(&i), "{i:?}");
                came += 1;
            }
        }
        came += u64::from(intrinsics::color_in_depth(&t).is_ok_and(|p| {
            assert!(good_pose(&p));
            true
        }));
        assert_eq!(RgbTable::parse(&t.build()).map(|t| t.build()).ok(), Some(t.build()));
    }
    let items = RectifiedItem::parse_all(&table);
    assert_eq!(RectifiedItem::build_all(&items), table.get(..20 * items.len()).unwrap_or_default());
    came
}

/// Payload headers with blocks, alone and in the records of a metadata node; how many have a time or a counter.
pub fn metadata(bytes: &[u8]) -> u64 {
    let one = |header: &[u8]| {
        let Some(all) = Metadata::parse(header) else { return 0 };
        let _ = (all.exposure_us(), all.gain(), all.configuration.and_then(|c| c.trigger()));
        u64::from(all.mid_exposure_us().is_some()) + u64::from(all.frame_counter().is_some())
    };
    let mut came = one(bytes);
    for format in [RecordFormat::Standard, RecordFormat::Whole] {
        let mut total = 0;
        for record in records(bytes, format) {
            total += 10 + record.header.len();
            came += one(record.header);
        }
        assert!(total <= bytes.len(), "records overlap");
    }
    came
}

/// The tables of an L515, and its other replies; how many results came of it.
///
/// # Panics
/// When intrinsics, a unit or a pose that are returned are not finite.
pub fn l515(bytes: &[u8]) -> u64 {
    let mut came = 0;
    if let Ok(t) = DepthIntrinsics::parse(bytes) {
        if let Ok(unit) = t.unit_m() {
            assert!(unit.is_finite() && unit > 0.0, "{unit}");
            came += 1;
        }
        let sizes: Vec<_> = t.sizes.iter().map(|s| (s.world.lens.width, s.world.lens.height)).collect();
        for (w, h) in sizes {
            came += u64::from(t.at(w, h).is_ok_and(|i| {
                assert!(good(&i), "{i:?}");
                true
            }));
        }
        assert_eq!(DepthIntrinsics::parse(&t.build()).map(|t| t.build()).ok(), Some(t.build()));
    }
    if let Ok(t) = ColorIntrinsics::parse(bytes) {
        for (w, h) in t.sizes.iter().map(|l| (l.width, l.height)) {
            came += u64::from(t.at(w, h).is_ok_and(|i| {
                assert!(good(&i), "{i:?}");
                true
            }));
        }
        assert_eq!(ColorIntrinsics::parse(&t.build()).map(|t| t.build()).ok(), Some(t.build()));
    }
    if let Ok(pose) = ColorExtrinsics::parse(bytes).and_then(|e| e.color_in_depth()) {
        assert!(good_pose(&pose), "{pose:?}");
        came += 1;
    }
    let mut monitor = FixedReply(bytes);
    let _ = (Temperatures::parse(bytes), Control::LaserPower.range(&mut monitor));
    let _ = Control::LaserPower.set(&mut monitor, 50);
    came
}

/// The IMU's table of a D400 or an L515. Of an odd number of bytes it gets its checksum put right. Whether it is taken.
///
/// # Panics
/// When a pose, a sample or a stated value of the correction is not finite.
pub fn imu(bytes: &[u8]) -> u64 {
    let mut table = bytes.to_vec();
    if let (1, Some(payload)) = (bytes.len() % 2, bytes.get(tables::HEADER..)) {
        put(&mut table, 12, &crc32fast::hash(payload).to_le_bytes());
    }
    let Ok(calibration) = ImuCalibration::parse(&table, 0x0B3A) else { return 0 };
    assert!(good_pose(&calibration.pose), "{calibration:?}");
    for counts in [[0; 3], [i32::MAX; 3], [i32::MIN, 1, i32::MAX]] {
        let samples = [
            calibration.acceleration_m_s2(counts),
            calibration.rotation_rad_s(counts, 32),
            calibration.rotation_rad_s(counts, 16),
        ];
        assert!(samples.iter().flatten().all(|v| v.is_finite()), "{calibration:?}: {samples:?}");
    }
    let stated = calibration.stated();
    assert!(!stated.contains("NaN") && !stated.contains("inf"), "{stated}");
    1
}

/// The text of a preset file; how many groups it sets.
///
/// # Panics
/// When a group has not the bytes that the camera takes, or one is set twice.
pub fn preset(bytes: &[u8]) -> u64 {
    let Ok(preset) = core::str::from_utf8(bytes).map_err(drop).and_then(|t| Preset::parse(t).map_err(drop))
    else {
        return 0;
    };
    for (group, data) in &preset.groups {
        assert_eq!(data.len(), group.bytes());
    }
    assert!(preset.groups.is_sorted_by(|a, b| a.0 < b.0));
    preset.groups.len() as u64
}

#[cfg(test)]
mod tests {
    use depthrig_corpus::run;

    #[test]
    fn hwm() {
        run("realsense_hwm", super::hwm);
    }

    #[test]
    fn gvd() {
        run("realsense_gvd", super::gvd);
    }

    #[test]
    fn tables() {
        run("realsense_tables", super::tables);
    }

    #[test]
    fn metadata() {
        run("realsense_metadata", super::metadata);
    }

    #[test]
    fn l515() {
        run("realsense_l515", super::l515);
    }

    #[test]
    fn imu() {
        run("realsense_imu", super::imu);
    }

    #[test]
    fn preset() {
        run("realsense_preset", super::preset);
    }
}
