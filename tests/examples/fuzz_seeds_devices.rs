//! Writes the seeds of the fuzz targets of what devices send:
//! `cargo run -p depthrig-tests --example fuzz_seeds_devices -- fuzz/corpus`.
//!
//! Each is what a whole and healthy camera would send. It is the start of a file in `fuzz/corpus/TARGET`, where those
//! that the fuzzer found lie too.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

use depthrig_bus::external::{About, ExternalAnswer, ExternalClock, ExternalFrame, Mode, fuzzing};
use depthrig_bus::{Intrinsics, Name, PixelFormat};
use depthrig_realsense::protocol::firmware::Firmware;
use depthrig_realsense::protocol::gvd::{Gvd, L515Gvd, Shutter};
use depthrig_realsense::protocol::hwm::{Code, Request, build_refusal, build_reply, build_unit_frame};
use depthrig_realsense::protocol::l515::{
    ColorExtrinsics, ColorIntrinsics, DepthIntrinsics, DepthLens, DepthPart, Lens,
};
use depthrig_realsense::protocol::metadata::{
    CaptureStats, CaptureTiming, ColorControl, Configuration, DepthControl, L515DepthControl, PayloadHeader,
    build_record,
};
use depthrig_realsense::protocol::tables::{Coefficients, Header, Pinhole, RectifiedItem, RgbTable, SIZES};
use depthrig_zed::replay::fake::FakeSvo;
use std::path::{Path, PathBuf};

const TURNED: [f32; 9] = [0.8, -0.6, 0.0, 0.6, 0.8, 0.0, 0.0, 0.0, 1.0];

fn coefficients() -> Coefficients {
    let mut c =
        Coefficients { version: [3, 2], baseline_mm: -49.9, distortion_model: 1, ..Coefficients::default() };
    for (entry, size) in c.rectified.iter_mut().zip(SIZES) {
        if let Some((w, h)) = size {
            let w = w as f32;
            let h = h as f32;
            *entry = Pinhole { fx: w * 0.5, fy: w * 0.5, ppx: w * 0.51, ppy: h * 0.49 };
        }
    }
    c
}

fn rgb() -> RgbTable {
    RgbTable {
        k: [1.4, 0.0, 0.01, 0.0, 2.5, -0.02, 0.0, 0.0, 1.0],
        distortion: [0.1, -0.2, 0.001, 0.002, 0.05],
        calibrated: (1920, 1080),
        rectified_rotation: TURNED,
        rectified_translation_mm: [-14.8, 0.1, 0.2],
        ..RgbTable::default()
    }
}

fn headers() -> (Vec<u8>, Vec<u8>, Vec<u8>) {
    let header = PayloadHeader { length: 0, flags: 0x82, pts: Some(1_000_000), scr: Some((1_000_100, 77)) };
    let timing = CaptureTiming {
        version: 1,
        frame_counter: Some(5),
        sensor_timestamp_us: Some(9000),
        exposure_us: Some(16_000),
        ..CaptureTiming::default()
    };
    let depth = DepthControl {
        gain: Some(16),
        exposure_us: Some(16_000),
        emitter: Some(1),
        ..DepthControl::default()
    };
    let color = ColorControl { gain: Some(64), auto_exposure: Some(true), ..ColorControl::default() };
    let mode =
        Configuration { width: Some(848), height: Some(480), trigger: Some(2), ..Configuration::default() };
    let l515 = L515DepthControl { laser_power: Some(9), ..L515DepthControl::default() };
    let timing = timing.build();
    let stats = CaptureStats::default().build();
    let mode = mode.build();
    let of = |blocks: &[Vec<u8>]| header.build(&blocks.concat()).unwrap();
    (
        of(&[timing.clone(), stats.clone(), depth.build(), mode.clone()]),
        of(&[timing.clone(), stats, color.build(), mode]),
        of(&[timing, l515.build()]),
    )
}

fn lens(width: u32, height: u32) -> Lens {
    let w = width as f32;
    Lens {
        width,
        height,
        fx: w * 0.7,
        fy: w * 0.7,
        ppx: w * 0.5,
        ppy: 240.0,
        distortion: [0.1, 0.2, 0.0, 0.0, 0.3],
    }
}

/// The IMU's table, with a little of everything.
fn imu_table(version: [u8; 2]) -> Vec<u8> {
    let mut numbers = vec![1, 1, 0, 0];
    let place = TURNED.into_iter().chain([-0.005, 0.005, 0.012]);
    let accelerometer = [1.01, 0.002, 0.0, -0.003, 0.99, 0.001, 0.0, 0.004, 1.0, 0.1, -0.2, 0.05];
    let gyroscope = [1.0, 0.0, 0.001, 0.0, 1.02, 0.0, 0.002, 0.0, 0.98, 0.3, -0.1, 0.2];
    numbers.extend(place.chain(accelerometer).chain(gyroscope).flat_map(f32::to_le_bytes));
    numbers.resize(numbers.len() + 96, 0);
    Header::close(0x20, version, 0, &numbers)
}

/// Puts a byte behind a table of an even length: with an odd number of bytes the target puts the checksum right.
fn odd(mut table: Vec<u8>) -> Vec<u8> {
    table.push(0);
    table
}

/// Messages of a process that serves a camera, in the form the target `external` takes: first a byte for the kind.
fn hand_shake(root: &Path) {
    let of = |kind: u8, bytes: Vec<u8>| [vec![kind], bytes].concat();
    let name = |n: &str| Name::new(n).unwrap();
    let color = Mode::new(name("color"), PixelFormat::Rgb8, 64, 48, 30.0);
    let depth = Mode::new(name("depth"), PixelFormat::Z16, 64, 48, 30.0).with_device_clock(32, 1_000_000, 16);
    let lens = Intrinsics::pinhole(50.0, 51.0, 31.5, 23.5);
    let jpeg = Mode { intrinsics: lens, ..Mode::new(name("jpeg"), PixelFormat::Mjpeg, 64, 48, 15.0) };
    let stamped = Mode { clock: ExternalClock::Host, ..color.clone() };
    let about =
        About { model: "Fake".into(), serial: "7".into(), program: "seed".into(), ..About::default() };
    let offer = |modes: &[Mode]| of(0, fuzzing::offer_bytes(&about, modes));
    put(root, "external", "offer", &offer(&[color, depth.clone(), jpeg]));
    put(root, "external", "offer_of_one", &offer(std::slice::from_ref(&depth)));
    let run = ExternalAnswer { instance: 7, session: 9, want: 1, modes: 3, ..ExternalAnswer::default() };
    put(root, "external", "answer", &of(1, fuzzing::answer_bytes(&run, &[1, 0, 1])));
    let mut refusal = ExternalAnswer { want: 2, reason: 2, ..run };
    refusal.text[..3].copy_from_slice(b"why");
    put(root, "external", "answer_refused", &of(1, fuzzing::answer_bytes(&refusal, &[])));
    for (seed, mode) in [("frames", depth), ("frames_host", stamped)] {
        let mut bytes = fuzzing::mode_bytes(&mode).to_vec();
        for n in [1u64, 2, 3, 5, 6] {
            let header = ExternalFrame {
                instance: 7,
                session: 9,
                sequence: n,
                device_sequence: n,
                device_time: 999_990_000_000 + n * 33_000_000,
                format: mode.format as u32,
                width: mode.width,
                height: mode.height,
                payload_len: mode.frame_bytes() as u32,
                ..ExternalFrame::default()
            };
            bytes.extend(header.payload_len.to_le_bytes());
            bytes.extend(33u16.to_le_bytes());
            bytes.extend(fuzzing::frame_bytes(&header));
        }
        put(root, "external", seed, &of(2, bytes));
    }
}

fn main() {
    let root: PathBuf = std::env::args().nth(1).expect("the folder of the corpus").into();
    hand_shake(&root);
    let gvd = Gvd {
        version: 5,
        firmware: Firmware::new(5, 16, 0, 1),
        serial: "830112070000".into(),
        asic_serial: "841512070000".into(),
        shutter: Shutter::Global,
        ..Gvd::default()
    };
    let l515_gvd = L515Gvd {
        firmware: Firmware::new(1, 5, 8, 1),
        serial: "f0000001".into(),
        asic_serial: "010203040506".into(),
        ..L515Gvd::default()
    };
    let reply = build_reply(Request::device_info().opcode(), &gvd.build());
    let unit = |reply: &[u8]| build_unit_frame(reply).unwrap().to_vec();
    put(&root, "realsense_hwm", "bulk", &reply);
    put(&root, "realsense_hwm", "unit", &unit(&reply));
    put(&root, "realsense_hwm", "table", &unit(&build_reply(0x15, &coefficients().build())));
    put(&root, "realsense_hwm", "request", &Request::calibration_table(25).to_bytes());
    put(&root, "realsense_hwm", "clock", &build_reply(1, &[1, 2, 3, 4]));
    // Too short to reach anything; the fuzzer starts from it all the same.
    put_found(&root, "realsense_hwm", "refusal", &build_refusal(Code::TABLE_IS_EMPTY));

    put(&root, "realsense_gvd", "d400", &gvd.build());
    put(&root, "realsense_gvd", "l515", &l515_gvd.build());

    put(&root, "realsense_tables", "coefficients", &coefficients().build());
    put(&root, "realsense_tables", "coefficients_odd", &odd(coefficients().build()));
    put(&root, "realsense_tables", "rgb", &rgb().build());
    put(&root, "realsense_tables", "rgb_odd", &odd(rgb().build()));
    let p = Pinhole { fx: 424.0, fy: 424.0, ppx: 423.0, ppy: 241.0 };
    let items = [RectifiedItem { width: 848, height: 480, pinhole: p }; 2];
    put_found(&root, "realsense_tables", "items", &RectifiedItem::build_all(&items));

    let (depth, color, l515) = headers();
    put(&root, "realsense_metadata", "depth", &depth);
    put(&root, "realsense_metadata", "color", &color);
    put(&root, "realsense_metadata", "l515", &l515);
    let records = [build_record(1, 2, &depth), build_record(3, 4, &color)].concat();
    put(&root, "realsense_metadata", "records", &records);
    let standard = depth.get(..12).unwrap_or_default();
    let cut = [build_record(1, 2, standard), build_record(3, 4, standard)].concat();
    put_found(&root, "realsense_metadata", "standard", &cut);

    let part = |w, h| DepthPart { lens: lens(w, h), zero_order: [1.0, 2.0], z_norm: 4.0 };
    let sizes = [(1024, 768), (640, 480)].map(|(w, h)| DepthLens { raw: part(w, h), world: part(w, h) });
    let depth = DepthIntrinsics { sizes: sizes.to_vec(), ..DepthIntrinsics::default() };
    put(&root, "realsense_l515", "depth", &depth.build());
    let color = ColorIntrinsics { shear: 0.1, sizes: vec![lens(1920, 1080), lens(1280, 720)] };
    put(&root, "realsense_l515", "color", &color.build());
    let pose = ColorExtrinsics { rotation: TURNED, translation_mm: [0.1, 14.0, -6.0] };
    put(&root, "realsense_l515", "extrinsics", &pose.build());

    let imu = imu_table([1, 1]);
    let memory = |table: &[u8]| Header::close(0x09, [1, 1], 0, &Header::close(0x10, [1, 1], 0, table));
    put(&root, "realsense_imu", "d400", &memory(&imu));
    put(&root, "realsense_imu", "d400_odd", &odd(memory(&imu)));
    put(&root, "realsense_imu", "l515", &imu_table([5, 1]));
    put(&root, "realsense_imu", "l515_odd", &odd(imu_table([5, 1])));

    let preset =
        r#"{"name": "near", "groups": {"depth_table": [100, 0, 65535, 0, -3], "amplitude_factor": [0.08]}}"#;
    put(&root, "realsense_preset", "near", preset.as_bytes());
    let every = r#"{"groups": {"census_radius": [9, 9], "ae_control": [400], "hdad": [26.0, 800.0, 0], "rsm": [0, 3.8, 1, 71]}}"#;
    put(&root, "realsense_preset", "groups", every.as_bytes());

    let svo = FakeSvo { per_chunk: 2, ..FakeSvo::strips((16, 16), 3) };
    put(&root, "zed_svo2", "chunks", &svo.build());
    put(&root, "zed_svo2", "no_index", &FakeSvo { indexed: false, ..svo.clone() }.build());
    put(&root, "zed_svo2", "loose", &FakeSvo { chunked: false, ..svo }.build());
    put_found(&root, "zed_svo2", "h264", &FakeSvo::h264((16, 16), 4).build());
}

/// A seed, which must reach something.
fn put(root: &Path, target: &str, name: &str, bytes: &[u8]) {
    put_found(root, target, &format!("seed_{name}"), bytes);
}

fn put_found(root: &Path, target: &str, name: &str, bytes: &[u8]) {
    let dir = root.join(target);
    std::fs::create_dir_all(&dir).unwrap();
    std::fs::write(dir.join(name), bytes).unwrap();
    println!("{target}/{name}: {} bytes", bytes.len());
}
