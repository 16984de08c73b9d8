use super::super::ways::Way;
use super::*;
use crate::ErrorKind;
use crate::status::{CameraState, CameraStatus, LinkState, LinkStatus, RigStatus, StreamStatus};
use depthrig_link::rates::Rates;

const TWO: &str = r#"
rig = "mount"
[recording]
directory = "/data"
[link]
host = "right"
listen = "10.0.0.1:7447"
[[link.hosts]]
name = "left"
ssh = "lab@left"
mirror = ["wrist/color", "wrist/depth"]
[[camera]]
name = "front"
backend = "synthetic"
"#;

fn way(rates: core::result::Result<Rates, String>) -> Way {
    Way { host: "left".parse().unwrap(), ssh: Some(("lab@left".into(), rates)), daemon: None }
}

fn mb_s(from_there: f64) -> Rates {
    Rates { from_there: from_there * 1e6, to_there: 110e6, round_trip_us: 420.0 }
}

fn found(way: Way) -> (Vec<(&'static str, Severity)>, String) {
    let report = host_report(TWO, |h| h.ways = vec![way]);
    (ids(&report), all_text(&report.findings))
}

#[test]
fn ways_to_other_computers_are_judged_by_their_rate() {
    assert_eq!(found(way(Ok(mb_s(112.0)))).0, [("host_reached", Severity::Info)]);
    let (slow, text) = found(way(Ok(mb_s(2.4))));
    assert_eq!(slow, [("host_slow", Severity::Warning)]);
    assert!(text.contains("host left: 2 MB/s from there, 110 MB/s to there, round trip 0.4 ms"), "{text}");
    let (away, text) = found(way(Err("ssh lab@left: Permission denied (publickey).".into())));
    assert_eq!(away, [("host_unreachable", Severity::Error)]);
    assert!(text.contains("Permission denied") && text.contains("ssh-copy-id lab@left"), "{text}");
}

/// The answer of left's daemon when all is well.
fn left() -> RigStatus {
    let stream = |id: &str, format: &str| StreamStatus {
        id: id.into(),
        format: format.into(),
        width: 1280,
        height: 720,
        nominal_hz: 30.0,
        ..StreamStatus::default()
    };
    let camera = CameraStatus {
        name: "wrist".into(),
        state: CameraState::Streaming,
        streams: vec![stream("wrist/color", "rgb8"), stream("wrist/depth", "z16")],
        ..CameraStatus::default()
    };
    let link = LinkStatus {
        host: "left".into(),
        insecure: false,
        recorder: Some("10.0.0.1:7447".into()),
        state: LinkState::Unkeyed,
        offset_s: None,
        uncertainty_us: None,
        rate_ppm: None,
        epoch: None,
        round_trip_us: None,
        age_s: None,
        exchanges: 0,
        refused: 0,
    };
    RigStatus { rig: "mount".into(), cameras: vec![camera], link: Some(link), ..RigStatus::default() }
}

/// The finding about the daemon there, and the text of all.
fn of_daemon(status: RigStatus, from_there: f64) -> (&'static str, Severity, String) {
    let (ids, text) = found(Way { daemon: Some(Ok(status)), ..way(Ok(mb_s(from_there))) });
    let of_way = |id: &&(&str, Severity)| !["host_reached", "host_slow"].contains(&id.0);
    let [(id, severity)] = ids.iter().filter(of_way).collect::<Vec<_>>()[..] else { panic!("{ids:?}") };
    (id, *severity, text)
}

#[test]
fn mirrored_streams_are_held_against_the_way() {
    // 1280x720 at 30 Hz: 82.9 MB/s of colour and 55.3 of depth; a seventh and 1/4.5 of that encoded.
    let (id, severity, text) = of_daemon(left(), 200.0);
    assert_eq!((id, severity), ("mirror_fits", Severity::Info));
    assert!(text.contains("have 138 MB/s raw, about 24 MB/s encoded, the way carries 200 MB/s"), "{text}");
    assert!(text.contains("they fit as they are"), "{text}");
    let (id, severity, text) = of_daemon(left(), 112.0);
    assert_eq!((id, severity), ("mirror_fits", Severity::Info));
    assert!(text.contains("they come encoded"), "{text}");
    let (id, severity, _) = of_daemon(left(), 12.0);
    assert_eq!((id, severity), ("mirror_slow", Severity::Warning));
    let mut without = left();
    without.cameras[0].streams.pop();
    let (ids, text) = found(Way { daemon: Some(Ok(without)), ..way(Ok(mb_s(200.0))) });
    assert!(ids.contains(&("mirror_missing", Severity::Warning)), "{ids:?}");
    assert!(
        text.contains("host left has no stream wrist/depth, which is mirrored; it has wrist/color"),
        "{text}"
    );
}

#[test]
fn a_daemon_that_would_be_refused_is_an_error_before_the_session() {
    let refused = |change: &dyn Fn(&mut RigStatus), expected: &str| {
        let mut status = left();
        change(&mut status);
        let (id, severity, text) = of_daemon(status, 200.0);
        assert_eq!((id, severity), ("host_refused", Severity::Error), "{expected}");
        assert!(text.contains(expected), "{text}");
    };
    refused(&|s| s.rig = "other".into(), "host left: its rig is \"other\"");
    refused(&|s| s.link = None, "its rig file has no [link]");
    refused(&|s| s.link.as_mut().unwrap().host = "top".into(), "its name is \"top\"");
    refused(&|s| s.link.as_mut().unwrap().recorder = None, "a session has one computer with listen");
    refused(&|s| s.link.as_mut().unwrap().insecure = true, "only one of both has insecure = true");
    refused(&|s| s.cameras[0].name = "front".into(), "camera \"front\" is a name on this computer, too");
}

#[test]
fn a_daemon_that_is_ill_silent_or_of_another_version_is_named() {
    let mut ill = left();
    ill.cameras[0].state = CameraState::Failed;
    let (id, severity, text) = of_daemon(ill, 200.0);
    assert_eq!((id, severity), ("host_cameras", Severity::Warning));
    assert!(text.contains("host left: 1 of 1 cameras do not stream: wrist"), "{text}");
    for (kind, id, severity) in [
        (ErrorKind::Unreachable, "host_silent", Severity::Info),
        (ErrorKind::Other, "host_version", Severity::Error),
    ] {
        let daemon = Some(Err((kind, "it is so".to_owned())));
        let (ids, text) = found(Way { daemon, ..way(Ok(mb_s(200.0))) });
        assert!(ids.contains(&(id, severity)) && text.contains("it is so"), "{ids:?} {text}");
    }
    // Without rates, through a socket that something else connects, the daemon is judged all the same.
    let report = host_report(TWO, |h| {
        h.ways = vec![Way {
            host: "left".parse().unwrap(),
            ssh: None,
            daemon: Some(Ok(RigStatus { link: None, ..left() })),
        }];
    });
    assert_eq!(ids(&report), [("host_refused", Severity::Error)]);
}
