//! Publishes and reads signals without a robot: the other side of the tests in Python.
//!
//! ```text
//! cargo run -p depthrig-bus --example signals -- publish RUNTIME_DIR
//! cargo run -p depthrig-bus --example signals -- read RUNTIME_DIR DEVICE/SIGNAL COUNT
//! cargo run -p depthrig-bus --example signals -- dump FOLDER
//! cargo run --release -p depthrig-bus --example signals -- time RUNTIME_DIR SECONDS
//! ```
//! `publish` waits for a number on stdin, publishes that many samples of `test/arm`, `test/mixed` and `test/tool_pose`, prints
//! the last sequence number, and so on until stdin ends. Sample k has the time 1 s + k · 10 ms. `read` prints a JSON object
//! for each sample. `dump` writes a header with a distinct value in every field, as bytes and as JSON. `time` publishes twenty
//! signals of seven doubles a thousand times a second, and prints how long a call takes.

use depthrig_bus::{
    FieldType, HostTime, RuntimeDir, SignalDescription, SignalField, SignalFlags, SignalHeader, SignalSample,
    Signals, Stamp, Value, signal,
};
use std::error::Error;
use std::io::BufRead;
use std::path::Path;
use std::time::Duration;

const TIMEOUT: Duration = Duration::from_secs(20);

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    match args[..] {
        ["publish", folder] => publish(folder.as_ref()),
        ["read", folder, name, count] => read(folder.as_ref(), name, count.parse()?),
        ["dump", folder] => dump(folder.as_ref()),
        ["time", folder, seconds] => time(folder.as_ref(), seconds.parse()?),
        _ => Err("publish RUNTIME_DIR, read RUNTIME_DIR DEVICE/SIGNAL COUNT, dump FOLDER, or time RUNTIME_DIR SECONDS".into()),
    }
}

fn time(folder: &Path, seconds: u32) -> Result<(), Box<dyn Error>> {
    let signals = Signals::open(&RuntimeDir::at(folder)?)?;
    let joints = ["j0", "j1", "j2", "j3", "j4", "j5", "j6"];
    let mut publishers = Vec::new();
    for i in 0..20 {
        let name = format!("time/s{i}").parse()?;
        publishers.push(signals.publisher(&SignalDescription::joints(name, &joints, "rad")?)?);
    }
    let mut took_ns = Vec::with_capacity(20_000 * seconds as usize);
    let begun = HostTime::now();
    for k in 0..1000 * i64::from(seconds) {
        std::thread::sleep(begun.plus_ns(k * 1_000_000).from_now());
        for publisher in &mut publishers {
            let before = HostTime::now();
            publisher.publish([k as f64; 7])?;
            took_ns.push(HostTime::now().since_ns(before));
        }
    }
    took_ns.sort_unstable();
    let at = |share: f64| took_ns[(share * (took_ns.len() - 1) as f64) as usize] as f64 / 1e3;
    println!("p50 {:.1}, p99 {:.1}, p99.9 {:.1} us", at(0.5), at(0.99), at(0.999));
    Ok(())
}

fn publish(folder: &Path) -> Result<(), Box<dyn Error>> {
    let signals = Signals::open(&RuntimeDir::at(folder)?)?;
    let field = |name: &str, kind| SignalField::new(name, kind, "");
    let fields = vec![
        field("flag", FieldType::Bool),
        SignalField::new("pair", FieldType::F64, "N·m").with_count(2),
        field("single", FieldType::F32),
        field("count", FieldType::I64),
        field("note", FieldType::Text),
    ];
    let arm = SignalDescription::joints("test/arm".parse()?, &["shoulder", "elbow", "wrist"], "rad")?;
    let mut arm = signals.publisher(&arm)?;
    let mut mixed = signals.publisher(&SignalDescription::fields("test/mixed".parse()?, fields)?)?;
    let mut pose = signals.publisher(&SignalDescription::pose("test/tool_pose".parse()?, "base")?)?;
    println!("ready");
    let mut k = 0;
    for line in std::io::stdin().lock().lines() {
        for _ in 0..line?.trim().parse::<u64>()? {
            k += 1;
            let x = k as f64;
            let time = HostTime::from_ns(1_000_000_000 + 10_000_000 * k as i64);
            let stamp = Stamp { uncertainty_ns: 1000 * k, ..Stamp::at(time) };
            arm.publish_at(&stamp, [x, x / 2.0, -x])?;
            let note = format!("sample {k} \"quoted\"\n🦾");
            let values = [
                Value::Bool(k % 2 == 1),
                Value::F64(x),
                Value::F64(f64::NAN),
                Value::F32(x as f32 / 4.0),
                Value::I64((k * k) as i64),
                Value::Text(&note),
            ];
            mixed.publish_at(&stamp, values)?;
            let half = 0.05 * x; // a turn of 0.1 rad about z for each sample
            pose.publish_at(&stamp, [x / 10.0, 0.0, 0.0, 0.0, 0.0, half.sin(), half.cos()])?;
        }
        println!("{k}");
    }
    Ok(())
}

fn read(folder: &Path, name: &str, count: usize) -> Result<(), Box<dyn Error>> {
    let signals = Signals::open(&RuntimeDir::at(folder)?)?;
    let mut subscriber = signals.subscriber_within(&name.parse()?, TIMEOUT)?;
    println!("ready");
    for _ in 0..count {
        let sample = subscriber.next_timeout(TIMEOUT)?.ok_or("no sample came in time")?;
        println!("{}", json(&sample));
    }
    Ok(())
}

fn json(sample: &SignalSample) -> serde_json::Value {
    let header = sample.header();
    let values: Vec<_> = sample
        .values()
        .map(|value| match value {
            Value::Text(text) => serde_json::json!(text),
            Value::Bool(b) => serde_json::json!(b),
            Value::I64(n) => serde_json::json!(n),
            // NaN is null.
            other => serde_json::json!(other.number()),
        })
        .collect();
    serde_json::json!({
        "sequence": header.sequence, "session": header.session, "time_ns": header.time_ns,
        "publish_time_ns": header.publish_time_ns, "uncertainty_ns": header.uncertainty_ns, "flags": header.flags,
        "description": sample.description().json(), "hash": sample.description().hash(), "values": values,
    })
}

fn dump(folder: &Path) -> Result<(), Box<dyn Error>> {
    let h = SignalHeader {
        sequence: 0x0102_0304_0506_0708,
        session: 0x1112_1314_1516_1718,
        time_ns: -0x2122_2324_2526_2728,
        publish_time_ns: 0x3132_3334_3536_3738,
        uncertainty_ns: 0x4142_4344_4546_4748,
        description_hash: 0xF1F2_F3F4_F5F6_F7F8,
        description_len: 0x5152_5354,
        payload_len: 0x6162_6364,
        flags: SignalFlags::REPLAYED.with(SignalFlags::INTERPOLATED).0,
        reserved_word: 0x7172_7374,
        reserved: core::array::from_fn(|i| 0x8182_8384_0000_0000 + i as u64),
        ..SignalHeader::default()
    };
    #[allow(unsafe_code)]
    // SAFETY: `SignalHeader` is `#[repr(C)]` plain data without padding (the bus tests that its fields cover every byte), and
    // `h` lives until the bytes are written.
    let bytes =
        unsafe { core::slice::from_raw_parts((&raw const h).cast::<u8>(), signal::SIGNAL_HEADER_SIZE) };
    let json = serde_json::json!({
        "magic": h.magic, "version": h.version, "size": h.size, "sequence": h.sequence, "session": h.session,
        "time_ns": h.time_ns, "publish_time_ns": h.publish_time_ns, "uncertainty_ns": h.uncertainty_ns,
        "description_hash": h.description_hash, "description_len": h.description_len, "payload_len": h.payload_len,
        "flags": h.flags, "reserved_word": h.reserved_word, "reserved": h.reserved,
    });
    std::fs::create_dir_all(folder)?;
    std::fs::write(folder.join("header.bin"), bytes)?;
    std::fs::write(folder.join("header.json"), serde_json::to_string_pretty(&json)?)?;
    Ok(())
}
