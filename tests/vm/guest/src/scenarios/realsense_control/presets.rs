//! A preset and a sync mode reach the camera; an unsupported one is refused with the reason.

use super::{config, nodes, start};
use crate::checks::Checks;
use crate::subject::plug;
use crate::tally::Tally;
use core::time::Duration;
use depthrig_driver::ErrorKind;
use depthrig_emulator::{Camera, Fault, Options, WrongReply};
use depthrig_realsense::config::RealsenseConfig;
use depthrig_realsense::protocol::advanced::{self, Bound, Group};
use depthrig_realsense::protocol::hwm::{Retry, UNIT_ID, UnitMonitor};
use depthrig_realsense::protocol::sync::SyncMode;
use std::path::PathBuf;

const PRESET: &str = r#"{
  "name": "near, fine steps",
  "groups": { "depth_table": [500, 100, 60000, 0, 12], "census_radius": [9, 7], "amplitude_factor": [0.08] }
}"#;
/// The groups of [`PRESET`] on the wire.
const GROUPS: [(Group, &[u32]); 3] = [
    (Group::DepthTable, &[500, 100, 60_000, 0, 12]),
    (Group::CensusRadius, &[9, 7]),
    // 0.08 as a float.
    (Group::AmplitudeFactor, &[0x3DA3_D70A]),
];
/// Opcodes of SET_ADV and SET_CAM_SYNC.
const SET_GROUP: u32 = 0x2B;
const SET_SYNC: u32 = 0x69;
/// More than any request is sent again.
const MANY: u32 = 1000;

/// Runs all of it on `camera`, and on models that lack something.
///
/// # Errors
/// When a node or a camera is not there.
pub(super) fn run(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let preset = PathBuf::from("/tmp/preset.json");
    std::fs::write(&preset, PRESET)?;
    let asked = |camera: &Camera| RealsenseConfig {
        preset: Some(preset.clone()),
        sync: Some(SyncMode::Genlock(2)),
        ..config(camera)
    };
    let before = camera.asked().len();
    let Some(mut stream) = checks.done("it starts with a preset and a sync mode", start(asked(camera)))
    else {
        return Ok(());
    };
    // Requests as the camera received them; current values through another reader than the driver that streams.
    let received: Vec<_> = camera.asked().into_iter().skip(before).collect();
    let mut monitor = UnitMonitor::new(nodes(camera)?.0, UNIT_ID, Retry::default());
    for (group, values) in GROUPS {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let name = group.name();
        let times = received
            .iter()
            .filter(|a| a.opcode == SET_GROUP && a.params[0] == group as u32 && a.data == bytes)
            .count();
        checks.equal(&format!("the camera got {name} once, to the byte"), times, 1);
        let now = advanced::get(&mut monitor, group, Bound::Current)?;
        checks.equal(&format!("and has it: {name}"), now, bytes);
    }
    let groups = received.iter().filter(|a| a.opcode == SET_GROUP).count();
    checks.equal("no other group was written", groups, GROUPS.len());
    let sync = received.iter().filter(|a| a.opcode == SET_SYNC).map(|a| a.params[0]).collect::<Vec<_>>();
    checks.equal("the camera got the sync mode once, with its two frames for each pulse", sync, [0x0204]);
    checks.equal("and has it", SyncMode::read(&mut monitor)?, SyncMode::Genlock(2));
    // A camera that nobody read from goes on streaming, and takes no sync mode then.
    Tally::default().poll_for(stream.as_mut(), Duration::from_millis(300))?;
    drop(stream);
    refused(checks, camera, &asked(camera))?;
    lacking(checks)
}

/// Checks that starting with `config` fails as it should.
fn fails(checks: &mut Checks, what: &str, config: RealsenseConfig, kind: ErrorKind, words: &[&str]) {
    let refused = start(config).err();
    let text = refused.as_ref().map_or_else(|| "it started".to_owned(), ToString::to_string);
    let holds = refused.is_some_and(|e| e.kind() == kind) && words.iter().all(|w| text.contains(w));
    checks.that(&format!("{what}: {kind:?} with a message that says {words:?}"), holds, text);
}

/// The camera itself refuses.
fn refused(checks: &mut Checks, camera: &Camera, asked: &RealsenseConfig) -> anyhow::Result<()> {
    let serial = camera.serial();
    for (to, code, kind, words) in [
        (
            SET_GROUP,
            -6,
            ErrorKind::Protocol,
            ["near, fine steps", "depth_table", "a parameter is wrong (code -6). Correct it"],
        ),
        (
            SET_GROUP,
            -27,
            ErrorKind::Protocol,
            ["near, fine steps", "depth_table", "the table is locked (code -27). Correct it"],
        ),
        (
            SET_SYNC,
            -58,
            ErrorKind::Unsupported,
            ["genlock 2", "does not support it (code -58). Choose another", serial],
        ),
        (
            SET_SYNC,
            -7,
            ErrorKind::Busy,
            ["genlock 2", "not ready (code -7). It takes none while it streams", serial],
        ),
    ] {
        camera.fault(Fault::Reply { wrong: WrongReply::Code(code), to: Some(to), times: MANY })?;
        fails(checks, &format!("request {to:#x} refused with {code}"), asked.clone(), kind, &words);
        camera.fault(Fault::Clear)?;
    }
    let again = start(asked.clone());
    checks.that("and it starts when it refuses no more", again.is_ok(), "");
    drop(again);
    let missing = RealsenseConfig { preset: Some("/tmp/no.json".into()), ..config(camera) };
    fails(checks, "a preset that is not there", missing, ErrorKind::BadInput, &["/tmp/no.json", serial]);
    Ok(())
}

/// Models without the connector, and without the shutter for it.
fn lacking(checks: &mut Checks) -> anyhow::Result<()> {
    for (model, sync, words) in
        [("d405", SyncMode::Master, "no connector"), ("d415", SyncMode::FullSlave, "global shutter")]
    {
        let camera = plug(model, Options::default())?;
        let asked = RealsenseConfig { sync: Some(sync), ..config(&camera) };
        fails(checks, model, asked, ErrorKind::Unsupported, &[words, camera.serial()]);
        let received = camera.asked().iter().any(|a| a.opcode == SET_SYNC);
        checks.that(&format!("{model}: and it was not even asked"), !received, "");
    }
    Ok(())
}
