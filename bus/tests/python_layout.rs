//! Generates Python's mirror of the bus, `python/src/depthrig/_layout.py`, and fails when the checked-in file differs.
//!
//! `DEPTHRIG_UPDATE=1 cargo test -p depthrig-bus --test python_layout` rewrites it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::format_push_string, unsafe_code)]

use core::mem::offset_of;
use depthrig_bus::external::{
    self, ANSWER_FIELDS, ExternalAnswer, ExternalClock, ExternalFrame, ExternalFrameFlags, ExternalMode,
    ExternalModeFlags, ExternalOffer, ExternalReason, ExternalState, ExternalWant, FRAME_FIELDS, MODE_FIELDS,
    OFFER_FIELDS,
};
use depthrig_bus::signal;
use depthrig_bus::{
    ClockDomain, Distortion, DropReason, FIELDS, Field, FrameFlags, FrameHeader, HEADER_SIZE, HEADER_VERSION,
    IOX_FOLDER, MOTION_FIELDS, MOTION_SAMPLE_BYTES, MotionFlags, PixelFormat, RECORD_BYTES, SCHEMA,
    SHM_PREFIX, SetHeader, SignalFlags, SignalHeader, StageStep, runtime::RUNTIME_DIR_VARIABLE,
};
use iceoryx2::prelude::ZeroCopySend;
use std::path::Path;

const PLACE: &str = "../python/src/depthrig/_layout.py";
const HEADER_SOURCE: &str = include_str!("../src/header.rs");
const GEOMETRY_SOURCE: &str = include_str!("../src/geometry.rs");
const SETS_SOURCE: &str = include_str!("../src/sets.rs");

macro_rules! set_fields {
    ($($name:ident: $kind:literal;)*) => {
        [$(Field { name: stringify!($name), offset: offset_of!(SetHeader, $name), kind: $kind, count: 1 }),*]
    };
}

#[test]
fn the_python_mirror_is_up_to_date() {
    let fresh = mirror();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(PLACE);
    if std::env::var_os("DEPTHRIG_UPDATE").is_some() {
        std::fs::write(&path, &fresh).unwrap();
    }
    let checked_in = std::fs::read_to_string(&path).unwrap_or_default();
    if let Some((i, (a, b))) = fresh.lines().zip(checked_in.lines()).enumerate().find(|(_, (a, b))| a != b) {
        panic!(
            "{PLACE} line {}: it has\n  {b}\nand Rust says\n  {a}\nrun this test with DEPTHRIG_UPDATE=1",
            i + 1
        );
    }
    assert!(
        fresh == checked_in,
        "{PLACE} is shorter or longer than it must be; run this test with DEPTHRIG_UPDATE=1"
    );
}

fn mirror() -> String {
    let sets = set_fields! {
        set_id: "u64";
        tick_ns: "i64";
        spread_ns: "i64";
        incomplete: "u64";
        members: "u32";
        present: "u32";
    };
    assert_eq!(
        sets.iter().map(Field::bytes).sum::<usize>(),
        size_of::<SetHeader>(),
        "a field is missing above"
    );
    let mut out = String::from(PREAMBLE);
    constants(&mut out);
    enums(&mut out);
    table(&mut out, "FIELDS", FIELDS);
    table(&mut out, "SET_FIELDS", &sets);
    table(&mut out, "MOTION_FIELDS", MOTION_FIELDS);
    table(&mut out, "EXTERNAL_OFFER_FIELDS", OFFER_FIELDS);
    table(&mut out, "EXTERNAL_MODE_FIELDS", MODE_FIELDS);
    table(&mut out, "EXTERNAL_ANSWER_FIELDS", ANSWER_FIELDS);
    table(&mut out, "EXTERNAL_FRAME_FIELDS", FRAME_FIELDS);
    table(&mut out, "SIGNAL_FIELDS", signal::SIGNAL_FIELDS);
    nested(&mut out, "intrinsics", "IntrinsicsFields", "Intrinsics", GEOMETRY_SOURCE);
    nested(&mut out, "pose", "PoseFields", "Pose", GEOMETRY_SOURCE);
    class(&mut out, "HeaderFields", "FrameHeader", HEADER_SOURCE, FIELDS);
    class(&mut out, "SetHeaderFields", "SetHeader", SETS_SOURCE, &sets);
    out
}

const PREAMBLE: &str = r#""""The layout of the bus, generated from Rust (bus/tests/python_layout.rs). Do not edit.

Run `DEPTHRIG_UPDATE=1 cargo test -p depthrig-bus --test python_layout` after a change in Rust.
"""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple

"#;

fn constants(out: &mut String) {
    // SAFETY: the function only returns a name; it is unsafe to implement, for the sake of other languages.
    let (header_type, set_type) =
        unsafe { (<FrameHeader as ZeroCopySend>::type_name(), <SetHeader as ZeroCopySend>::type_name()) };
    for (name, value) in [
        ("SCHEMA", format!("{SCHEMA:?}")),
        ("HEADER_TYPE", format!("{header_type:?}")),
        ("HEADER_VERSION", HEADER_VERSION.to_string()),
        ("HEADER_SIZE", HEADER_SIZE.to_string()),
        ("HEADER_ALIGN", align_of::<FrameHeader>().to_string()),
        ("HEADER_MAGIC", format!("b{:?}", core::str::from_utf8(&FrameHeader::default().magic).unwrap())),
        ("SET_HEADER_TYPE", format!("{set_type:?}")),
        ("SET_HEADER_SIZE", size_of::<SetHeader>().to_string()),
        ("SET_HEADER_ALIGN", align_of::<SetHeader>().to_string()),
        ("SET_RECORD_SIZE", RECORD_BYTES.to_string()),
        ("MOTION_SAMPLE_SIZE", MOTION_SAMPLE_BYTES.to_string()),
        ("SHM_PREFIX", format!("{SHM_PREFIX:?}")),
        ("IOX_FOLDER", format!("{IOX_FOLDER:?}")),
        ("RUNTIME_DIR_VARIABLE", format!("{RUNTIME_DIR_VARIABLE:?}")),
    ] {
        out.push_str(&format!("{name} = {value}\n"));
    }
    out.push_str("\n# Cameras that another process serves: docs/external.md\n");
    for (name, value) in external_constants() {
        out.push_str(&format!("EXTERNAL_{name} = {value}\n"));
    }
    out.push_str("\n# Signals: docs/signals.md\n");
    for (name, value) in signal_constants() {
        out.push_str(&format!("SIGNAL_{name} = {value}\n"));
    }
}

fn signal_constants() -> Vec<(&'static str, String)> {
    // SAFETY: as in `constants`.
    let header_type = unsafe { <SignalHeader as ZeroCopySend>::type_name() };
    let types = signal::FieldType::ALL.map(|t| format!("{:?}: {}", t.name(), t.bytes())).join(", ");
    let kinds = signal::SignalKind::ALL.map(|k| format!("{:?}", k.name())).join(", ");
    vec![
        ("VERSION", signal::SIGNAL_VERSION.to_string()),
        ("SCHEMA", format!("{:?}", signal::SCHEMA)),
        ("PREFIX", format!("{:?}", signal::PREFIX)),
        ("LOCK_SUFFIX", format!("{:?}", signal::LOCK_SUFFIX)),
        ("HEADER_TYPE", format!("{header_type:?}")),
        ("HEADER_SIZE", signal::SIGNAL_HEADER_SIZE.to_string()),
        ("HEADER_ALIGN", align_of::<SignalHeader>().to_string()),
        ("MAGIC", format!("b{:?}", core::str::from_utf8(&signal::SIGNAL_MAGIC).unwrap())),
        ("DESCRIPTION_VERSION", signal::DESCRIPTION_VERSION.to_string()),
        ("KINDS", format!("({kinds})")),
        ("TYPES", format!("{{{types}}}")),
        ("MAX_DESCRIPTION_BYTES", signal::MAX_DESCRIPTION_BYTES.to_string()),
        ("MAX_VALUES_BYTES", signal::MAX_VALUES_BYTES.to_string()),
        ("MAX_AHEAD_NS", signal::MAX_AHEAD.as_nanos().to_string()),
        ("SLOTS", signal::SLOTS.to_string()),
        ("BUFFER", signal::BUFFER.to_string()),
        ("MAX_HELD", signal::MAX_HELD.to_string()),
        ("MAX_PUBLISHERS", signal::MAX_PUBLISHERS.to_string()),
        ("MAX_SUBSCRIBERS", signal::MAX_SUBSCRIBERS.to_string()),
        ("MAX_NODES", signal::MAX_NODES.to_string()),
    ]
}

fn external_constants() -> Vec<(&'static str, String)> {
    // SAFETY: as in `constants`.
    let types = unsafe {
        [
            <ExternalOffer as ZeroCopySend>::type_name(),
            <ExternalMode as ZeroCopySend>::type_name(),
            <ExternalAnswer as ZeroCopySend>::type_name(),
            <ExternalFrame as ZeroCopySend>::type_name(),
        ]
    };
    let magic = |bytes: [u8; 4]| format!("b{:?}", core::str::from_utf8(&bytes).unwrap());
    vec![
        ("VERSION", external::VERSION.to_string()),
        ("SCHEMA", format!("{:?}", external::SCHEMA)),
        ("PREFIX", format!("{:?}", external::PREFIX)),
        ("LOCK_SUFFIX", format!("{:?}", external::LOCK_SUFFIX)),
        ("OFFER_TYPE", format!("{:?}", types[0])),
        ("OFFER_SIZE", size_of::<ExternalOffer>().to_string()),
        ("OFFER_MAGIC", magic(external::OFFER_MAGIC)),
        ("MODE_TYPE", format!("{:?}", types[1])),
        ("MODE_SIZE", size_of::<ExternalMode>().to_string()),
        ("ANSWER_TYPE", format!("{:?}", types[2])),
        ("ANSWER_SIZE", size_of::<ExternalAnswer>().to_string()),
        ("ANSWER_MAGIC", magic(external::ANSWER_MAGIC)),
        ("FRAME_TYPE", format!("{:?}", types[3])),
        ("FRAME_SIZE", size_of::<ExternalFrame>().to_string()),
        ("FRAME_MAGIC", magic(external::FRAME_MAGIC)),
        ("ALIGN", align_of::<ExternalOffer>().to_string()),
        ("HEARTBEAT_S", format!("{:?}", external::HEARTBEAT.as_secs_f64())),
        ("SILENCE_S", format!("{:?}", external::SILENCE.as_secs_f64())),
        ("MAX_MODES", external::MAX_MODES.to_string()),
        ("MAX_STREAMS", external::MAX_STREAMS.to_string()),
        ("MAX_FRAME_BYTES", external::MAX_FRAME_BYTES.to_string()),
        ("TEXT_SIZE", external::TEXT_BYTES.to_string()),
        ("FRAME_SLOTS", external::FRAME_SLOTS.to_string()),
        ("MAX_PUBLISHERS", external::MAX_PUBLISHERS.to_string()),
        ("MAX_SUBSCRIBERS", external::MAX_SUBSCRIBERS.to_string()),
        ("BUFFER", external::BUFFER.to_string()),
        ("MAX_HELD", external::MAX_HELD.to_string()),
        ("MAX_NODES", external::MAX_NODES.to_string()),
        ("MAX_EVENT_PORTS", external::MAX_EVENT_PORTS.to_string()),
        ("EVENT_ID", external::EVENT_ID.to_string()),
        ("RIG_VARIABLE", format!("{:?}", external::RIG_VARIABLE)),
        ("CAMERA_VARIABLE", format!("{:?}", external::CAMERA_VARIABLE)),
    ]
}

fn enums(out: &mut String) {
    let formats = PixelFormat::ALL.map(|f| (f.name().to_owned(), f as u32));
    let reasons = DropReason::ALL.map(|r| (r.name().to_owned(), r as u32));
    let models = Distortion::ALL.map(|d| (serde_name(d), d as u32));
    let domains = [ClockDomain::Arrival, ClockDomain::Device, ClockDomain::Kernel]
        .map(|d| (format!("{d:?}").to_lowercase(), d as u32));
    let flags = FrameFlags::ALL.map(|(name, flag)| (name.to_owned(), flag.0));
    enumeration(out, "IntEnum", "PixelFormat", "How the pixels of a frame are stored.", &formats);
    out.push_str("\n\n# Per format: NumPy's element type, its bytes, and how many of them a pixel has.\nELEMENTS = {\n");
    for f in PixelFormat::ALL.into_iter().filter(|f| f.layout().channels() > 0) {
        let name = f.name().to_uppercase();
        let bytes = f.sample().bytes();
        let channels = f.layout().channels();
        out.push_str(&format!("    PixelFormat.{name}: (\"{}\", {bytes}, {channels}),\n", f.numpy()));
    }
    out.push_str("}\n");
    enumeration(out, "IntEnum", "DropReason", "Why a captured frame never reached its channel.", &reasons);
    enumeration(out, "IntEnum", "Distortion", "The distortion model of a camera.", &models);
    enumeration(out, "IntEnum", "ClockDomain", "Where a capture time comes from.", &domains);
    let steps = StageStep::ALL.map(|s| (s.name().to_owned(), s as u32));
    enumeration(
        out,
        "IntEnum",
        "StageStep",
        "A step of computing a derived frame, by its place in `stage_ns`.",
        &steps,
    );
    enumeration(out, "IntFlag", "FrameFlags", "Facts about a frame, one bit each.", &flags);
    let flags = [
        ("frame_sync", MotionFlags::FRAME_SYNC),
        ("accel_clipped", MotionFlags::ACCEL_CLIPPED),
        ("gyro_clipped", MotionFlags::GYRO_CLIPPED),
    ]
    .map(|(name, flag)| (name.to_owned(), flag.0));
    enumeration(out, "IntFlag", "MotionFlags", "Facts about an IMU sample, one bit each.", &flags);
    let flags = SignalFlags::ALL.map(|(name, flag)| (name.to_owned(), flag.0));
    enumeration(out, "IntFlag", "SignalFlags", "Facts about a sample of a signal, one bit each.", &flags);
    external_enums(out);
}

fn external_enums(out: &mut String) {
    macro_rules! codes {
        ($($name:ident $doc:literal)*) => {$(
            let members: Vec<_> = $name::ALL.iter().map(|c| (c.name().to_owned(), *c as u32)).collect();
            enumeration(out, "IntEnum", stringify!($name), $doc, &members);
        )*};
    }
    macro_rules! bits {
        ($($name:ident $doc:literal)*) => {$(
            let members: Vec<_> = $name::ALL.iter().map(|(n, f)| ((*n).to_owned(), f.0)).collect();
            enumeration(out, "IntFlag", stringify!($name), $doc, &members);
        )*};
    }
    codes! {
        ExternalState "State of a process that serves a camera."
        ExternalWant "The daemon's request to a process that serves a camera."
        ExternalReason "Why one side refuses, or a process ends."
        ExternalClock "Which clock stamps the frames of a mode."
    }
    bits! {
        ExternalModeFlags "Facts about a mode, one bit each."
        ExternalFrameFlags "Facts about a frame, one bit each."
    }
}

fn serde_name(value: impl serde::Serialize) -> String {
    serde_json::to_value(value).unwrap().as_str().unwrap().to_owned()
}

fn enumeration(out: &mut String, base: &str, name: &str, doc: &str, members: &[(String, u32)]) {
    out.push_str(&format!("\n\nclass {name}(enum.{base}):\n    \"\"\"{doc}\"\"\"\n\n"));
    for (member, value) in members {
        out.push_str(&format!("    {} = {value}\n", member.to_uppercase()));
    }
}

fn table(out: &mut String, name: &str, fields: &[Field]) {
    out.push_str(&format!("\n\n# (name, offset, element type, elements)\n{name} = (\n"));
    for f in fields {
        out.push_str(&format!("    ({:?}, {}, {:?}, {}),\n", f.name, f.offset, f.kind, f.count));
    }
    out.push_str(")\n");
}

/// Python's type of a field, and the expression that reads it from `self._raw`.
fn python(f: &Field) -> (String, String) {
    let code = match f.kind {
        "u8" => "B",
        "u16" => "H",
        "u32" => "I",
        "u64" => "Q",
        "i64" => "q",
        "f32" => "f",
        "f64" => "d",
        other => panic!("{}: no Python type for {other}", f.name),
    };
    let plain = if f.kind.starts_with('f') { "float" } else { "int" };
    match (f.kind, f.count) {
        ("u8", 32) => ("str".into(), format!("_text(self._raw[{}:{}])", f.offset, f.offset + 32)),
        ("u8", n) => ("bytes".into(), format!("self._raw[{}:{}]", f.offset, f.offset + n)),
        (_, 1) => {
            (plain.into(), format!("{plain}(struct.unpack_from(\"<{code}\", self._raw, {})[0])", f.offset))
        }
        (_, n) => (
            format!("tuple[{plain}, ...]"),
            format!("struct.unpack_from(\"<{n}{code}\", self._raw, {})", f.offset),
        ),
    }
}

/// A named tuple of the fields below `prefix`.
fn nested(out: &mut String, prefix: &str, class: &str, rust: &str, source: &str) {
    out.push_str(&format!(
        "\n\nclass {class}(NamedTuple):\n    \"\"\"The fields of Rust's `{rust}`.\"\"\"\n\n"
    ));
    for f in FIELDS {
        if let Some(name) = f.name.strip_prefix(&format!("{prefix}.")) {
            let (kind, _) = python(f);
            out.push_str(&format!("    {name}: {kind}\n    \"\"\"{}\"\"\"\n", doc(source, rust, name)));
        }
    }
}

/// A class with one property for each plain field and one for each nested structure.
fn class(out: &mut String, class: &str, rust: &str, source: &str, fields: &[Field]) {
    out.push_str(&format!(
        "\n\nclass {class}:\n    \"\"\"The fields of Rust's `{rust}`, read from its bytes.\"\"\"\n\n    __slots__ = (\"_raw\",)\n\n    \
         def __init__(self, raw: bytes) -> None:\n        self._raw = raw\n"
    ));
    for f in fields.iter().filter(|f| !f.name.contains('.')) {
        let (kind, read) = python(f);
        out.push_str(&format!(
            "\n    @property\n    def {}(self) -> {kind}:\n        \"\"\"{}\"\"\"\n        return {read}\n",
            f.name,
            doc(source, rust, f.name)
        ));
    }
    for (prefix, tuple) in [("intrinsics", "IntrinsicsFields"), ("pose", "PoseFields")] {
        let inner: Vec<_> = fields.iter().filter(|f| f.name.starts_with(&format!("{prefix}."))).collect();
        if inner.is_empty() {
            continue;
        }
        out.push_str(&format!("\n    def _{prefix}(self) -> {tuple}:\n        return {tuple}(\n"));
        for f in inner {
            let (_, read) = python(f);
            out.push_str(&format!("            {read},\n"));
        }
        out.push_str("        )\n");
    }
    if class == "HeaderFields" {
        out.push_str(TEXT);
    }
}

const TEXT: &str = r#"

def _text(field: bytes) -> str:
    """Text in a zero-padded field; an invalid tail is left out, as Rust does."""
    field = field.split(b"\0", 1)[0]
    try:
        return field.decode("utf-8")
    except UnicodeDecodeError as e:
        return field[: e.start].decode("utf-8")
"#;

/// The doc comment of field `field` of `pub struct name` in `source`, on one line and without Rust's links.
fn doc(source: &str, name: &str, field: &str) -> String {
    let body = source.split_once(&format!("pub struct {name} {{")).expect(name).1;
    let body = body.split_once("\n}").expect("the end of the structure").0;
    let mut lines: Vec<&str> = Vec::new();
    for line in body.lines().map(str::trim) {
        if let Some(text) = line.strip_prefix("///") {
            lines.push(text.trim());
        } else if line.starts_with(&format!("pub {field}:")) {
            let text = lines.join(" ").replace("[`", "`").replace("`]", "`").replace("crate::", "");
            assert!(!text.is_empty(), "{name}.{field} has no doc comment");
            return text;
        } else {
            lines.clear();
        }
    }
    panic!("{name} has no field {field}");
}
