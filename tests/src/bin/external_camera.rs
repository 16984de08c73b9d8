//! A process that serves a camera and misbehaves on request: `external_camera BEHAVIOUR [SERIAL]`. The environment
//! names its place. Tests start it like a lab's own program.
#![allow(clippy::unwrap_used, clippy::expect_used)] // test support: a failure here is a failed test

use depthrig_bus::external::{
    About, ExternalCamera, ExternalFrame, ExternalOffer, ExternalReason, Mode, Place, Session, lock_camera,
};
use depthrig_bus::{HostTime, Name, PixelFormat};
use std::time::Duration;

const RATE_HZ: f64 = 30.0;

fn mode(name: &str, format: PixelFormat) -> Mode {
    Mode::new(Name::new(name).unwrap(), format, 160, 120, RATE_HZ).with_device_clock(32, 1_000_000, 32)
}

fn main() {
    let mut args = std::env::args().skip(1);
    let behaviour = args.next().expect("a behaviour");
    let place = Place::from_environment().unwrap();
    println!("behaves {behaviour}");
    let about = About {
        model: "Fake".into(),
        serial: args.next().unwrap_or_else(|| "1".into()),
        program: "external_camera".into(),
        ..About::default()
    };
    let modes = [mode("color", PixelFormat::Rgb8), mode("depth", PixelFormat::Z16)];
    match behaviour.as_str() {
        "crash_at_once" => std::process::exit(7),
        "never_offers" => std::thread::sleep(Duration::from_mins(10)),
        "locked_and_silent" => {
            let who = format!("process {} (external_camera)", std::process::id());
            let _lock = lock_camera(&place.runtime, &place.rig, &place.camera, &who).unwrap();
            std::thread::sleep(Duration::from_mins(10));
        }
        _ => {}
    }
    if let Some(lie) = behaviour.strip_prefix("offers_") {
        return offer_lie(&place, &modes, lie);
    }
    if behaviour == "ignores_term" {
        // A process that blocks the signal, as one whose SDK catches it would.
        ignore_term();
    }
    let mut camera = match ExternalCamera::offer(&place, &about, &modes) {
        Ok(camera) => camera,
        Err(e) => {
            println!("{e}");
            std::process::exit(3);
        }
    };
    loop {
        if behaviour == "absent" {
            camera
                .unavailable(ExternalReason::Busy, "the SDK says that another program has the sensor")
                .unwrap();
        }
        let Some(session) = camera.next_session(Duration::from_millis(200)).unwrap() else { continue };
        match behaviour.as_str() {
            "refuses" => session.refuse(ExternalReason::Unsupported, "this sensor has no such mode today"),
            "finishes" => {
                serve(session, "normal", 20);
                std::thread::sleep(Duration::from_mins(10));
            }
            "mute" => {
                while session.is_wanted() {
                    std::thread::sleep(Duration::from_millis(20));
                }
            }
            other => serve(session, other, u64::MAX),
        }
    }
}

/// Sends frames according to `behaviour` until they are no longer wanted.
fn serve(mut session: Session<'_>, behaviour: &str, frames: u64) {
    let running: Vec<(usize, Mode)> = session.modes().map(|(i, m)| (i, m.clone())).collect();
    session.started();
    let began = HostTime::now();
    for n in 1..=frames {
        if !session.is_wanted() {
            if let Some(why) = session.refusal() {
                println!("refused: {why}");
            }
            return;
        }
        if behaviour != "floods" {
            std::thread::sleep(began.plus(Duration::from_secs_f64(n as f64 / RATE_HZ)).from_now());
        }
        let now = HostTime::now();
        let facts = ExternalFrame {
            device_sequence: n,
            device_time: (now.ns() as u64 / 1000) & 0xFFFF_FFFF,
            arrival_time_ns: now.ns(),
            ..ExternalFrame::default()
        };
        for (index, mode) in &running {
            let Some(mut slot) = session.frame(*index, mode.frame_bytes()).unwrap() else { continue };
            slot.set_facts(&facts);
            slot.pixels_mut().fill(n as u8);
            let header = slot.header_mut();
            match behaviour {
                "other_size" => (header.width, header.height) = (640, 480),
                "single_lies" if n % 64 == 15 => header.format = 0xBAD,
                "says_more" if n.is_multiple_of(3) => header.payload_len = u32::MAX,
                "strange_numbers" => {
                    header.gain = f32::NAN;
                    header.temperature_c = f32::INFINITY;
                    header.exposure_ns = u64::MAX;
                    header.arrival_time_ns = if n % 2 == 0 { i64::MAX } else { i64::MIN };
                    header.flags |= 0xFFFF_FF00;
                    if n == 40 {
                        header.device_sequence = u64::MAX;
                        header.sequence = u64::MAX - 10;
                    }
                }
                _ => {}
            }
            session.send(slot).unwrap();
        }
    }
    let taken = session.finish("the file is at its end", Duration::from_secs(10));
    println!("the daemon has it all: {taken}");
}

/// Sends an invalid offer and prints the daemon's answer.
fn offer_lie(place: &Place, modes: &[Mode], lie: &str) {
    let mut offer = ExternalOffer { modes: 2, ..ExternalOffer::default() };
    offer.model[..4].copy_from_slice(b"Fake");
    let text = "external_camera";
    offer.program[..text.len()].copy_from_slice(text.as_bytes());
    let mut records = vec![0; 640];
    // A valid offer, by the offsets of docs/external.md.
    for (mode, record) in modes.iter().zip(records.chunks_exact_mut(320)) {
        let name = mode.stream.as_str();
        record[..name.len()].copy_from_slice(name.as_bytes());
        record[32..40].copy_from_slice(&mode.rate_hz.to_le_bytes());
        record[40..48].copy_from_slice(&mode.depth_unit_m.to_le_bytes());
        record[200..208].copy_from_slice(&1f64.to_le_bytes());
        record[208..216].copy_from_slice(&mode.tick_ps.to_le_bytes());
        for (at, word) in [
            (216, mode.format as u32),
            (220, mode.width),
            (224, mode.height),
            (228, mode.clock as u32),
            (232, mode.counter_bits),
            (236, mode.sequence_bits),
        ] {
            record[at..at + 4].copy_from_slice(&word.to_le_bytes());
        }
    }
    match lie {
        "nothing_wrong" => {}
        "another_version" => offer.version = 2,
        "another_size" => offer.size = 100,
        "fewer_modes" => offer.modes = 1,
        "no_name" => records[..32].copy_from_slice(&[0xFF; 32]),
        "nan_rate" => records[32..40].copy_from_slice(&f64::NAN.to_le_bytes()),
        "nan_pose" => records[152..160].copy_from_slice(&f64::NAN.to_le_bytes()),
        "huge_size" => records[220..224].copy_from_slice(&u32::MAX.to_le_bytes()),
        "bad_text" => offer.serial[0] = b'\x1b',
        other => panic!("there is no lie {other}"),
    }
    let mut camera = ExternalCamera::offer_unchecked(place, modes, offer, records).unwrap();
    loop {
        match camera.next_session(Duration::from_millis(200)) {
            Ok(Some(session)) => serve(session, "normal", u64::MAX),
            Ok(None) => {}
            Err(e) => {
                println!("{e}");
                std::thread::sleep(Duration::from_millis(200));
            }
        }
    }
}

fn ignore_term() {
    // Without unsafe code a process ignores a signal when its parent did: start again below a shell that does.
    if std::env::var_os("TERM_IS_IGNORED").is_none() {
        use std::os::unix::process::CommandExt;
        let me = std::env::current_exe().unwrap();
        let script = format!("trap '' TERM; exec '{}' ignores_term", me.display());
        let e =
            std::process::Command::new("/bin/sh").args(["-c", &script]).env("TERM_IS_IGNORED", "1").exec();
        panic!("{e}");
    }
}
