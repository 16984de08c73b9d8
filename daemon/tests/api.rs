//! The control API as others see it: over its socket and its port, against its own description. Long because
//! every route is in it, so that none is forgotten.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "api/fake.rs"]
mod fake;
#[path = "api/schema.rs"]
mod schema;
#[path = "api/strangers.rs"]
mod strangers;

use depthrig_bus::clock::HostTime;
use depthrig_bus::{RigName, RuntimeDir};
use depthrig_daemon::api::{self, MAX_BODY_BYTES, MAX_FOLLOWERS, OPENAPI, ROUTES, ServerHandle};
use depthrig_daemon::client::Client;
use depthrig_daemon::config::{ControlConfig, Port};
use depthrig_daemon::control::{RecordRequest, SeekRequest};
use depthrig_daemon::status::CameraState;
use depthrig_daemon::{Error, ErrorKind};
use fake::Fake;
use schema::Document;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;
use std::time::Duration;

/// A served rig with a fake behind it.
struct Served {
    fake: Arc<Fake>,
    runtime: RuntimeDir,
    rig: RigName,
    server: ServerHandle,
    lock: depthrig_bus::runtime::RigLock,
    _tmp: tempfile::TempDir,
}

/// The API on this port, and nothing for Foxglove.
fn tcp(tcp: Port) -> ControlConfig {
    ControlConfig { tcp, ..ControlConfig::default() }
}

fn served() -> Served {
    let tmp = tempfile::Builder::new().prefix("dr").rand_bytes(4).tempdir_in("/tmp").unwrap();
    let runtime = RuntimeDir::at(tmp.path()).unwrap();
    let rig = RigName::new("mount").unwrap();
    let lock = runtime.lock(&rig, "process 42 (rig.toml)").unwrap();
    let fake = Arc::new(Fake::default());
    let any_port = Port::At("127.0.0.1:0".parse().unwrap());
    let server = api::serve(fake.clone(), &runtime, &rig, tcp(any_port)).unwrap();
    Served { fake, runtime, rig, server, lock, _tmp: tmp }
}

struct Answer {
    status: u16,
    head: String,
    body: String,
}

impl Answer {
    fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|e| panic!("{e}: {}", self.body))
    }

    fn media_type(&self) -> String {
        let line = self.head.lines().find_map(|l| l.strip_prefix("content-type: "));
        line.unwrap_or_default().trim().to_owned()
    }
}

/// Sends `bytes` as they are and reads the answer; the request asks for the connection to be closed.
fn exchange(mut stream: impl Read + Write, bytes: &[u8]) -> Answer {
    // A refusal may come, and the connection go, before all of a large body was sent.
    let _ = stream.write_all(bytes);
    let mut text = Vec::new();
    let _ = stream.read_to_end(&mut text);
    let text = String::from_utf8(text).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or_else(|| panic!("no answer: {text:?}"));
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    Answer { status, head: head.to_ascii_lowercase(), body: body.to_owned() }
}

fn request(method: &str, path: &str, host: &str, content_type: Option<&str>, body: &str) -> String {
    let kind = content_type.map(|t| format!("content-type: {t}\r\n")).unwrap_or_default();
    let length = body.len();
    format!(
        "{method} {path} HTTP/1.1\r\nhost: {host}\r\n{kind}content-length: {length}\r\nconnection: close\r\n\r\n{body}"
    )
}

impl Served {
    fn unix(&self) -> UnixStream {
        UnixStream::connect(self.runtime.socket_path(&self.rig)).unwrap()
    }

    fn get(&self, path: &str) -> Answer {
        exchange(self.unix(), request("GET", path, "localhost", None, "").as_bytes())
    }

    fn post(&self, path: &str, body: &str) -> Answer {
        exchange(self.unix(), request("POST", path, "localhost", Some("application/json"), body).as_bytes())
    }

    fn port(&self) -> TcpStream {
        TcpStream::connect(self.server.tcp().unwrap()).unwrap()
    }

    /// Sends a request with the token.
    fn on_port(&self, text: &str) -> Answer {
        let with_token = format!("\r\nauthorization: Bearer {}\r\n", self.token());
        exchange(self.port(), text.replacen("\r\n", &with_token, 1).as_bytes())
    }

    fn token(&self) -> String {
        let text = std::fs::read_to_string(self.server.token_path().unwrap()).unwrap();
        text.trim_end().to_owned()
    }
}

#[test]
fn the_document_describes_every_call_and_no_other() {
    let document: Value = serde_json::from_str(OPENAPI).unwrap();
    let described: BTreeSet<_> = document["paths"]
        .as_object()
        .unwrap()
        .iter()
        .flat_map(|(path, calls)| {
            calls.as_object().unwrap().keys().map(move |m| (m.to_uppercase(), path.clone()))
        })
        .collect();
    let routed: BTreeSet<_> = ROUTES.iter().map(|r| (r.method.to_owned(), r.path.to_owned())).collect();
    assert_eq!(described, routed);
    assert_eq!(document["openapi"], "3.1.0");
    Document::new(document).check_itself();
}

/// Every route, in every situation that it has an answer for: the answer's status and media type are described,
/// and its body fits the schema, which has every field and no other.
/// Bodies for an episode, and the status of the answer.
const EPISODES: [(&str, u16); 5] = [
    (r#"{"action": "start", "task": "cup"}"#, 200),
    (r#"{"action": "stop"}"#, 409),
    (r#"{"action": "go"}"#, 400),
    (r#"{"action": "start", "outcome": "success"}"#, 400),
    ("{}", 400),
];

/// Calls that a rig without cameras and recordings refuses.
const WITHOUT_CAMERAS: [(&str, &str); 9] = [
    ("/v1/recordings/mark", r#"{"name": "x", "mark": "bad"}"#),
    ("/v1/recordings/report", r#"{"name": "x"}"#),
    ("/v1/session/follow", r#"{"key": "000102030405060708090a0b0c0d0e0f", "phase_ns": 7}"#),
    ("/v1/recordings/files", r#"{"name": "x"}"#),
    ("/v1/recordings/bytes", r#"{"name": "x", "file": "session.toml", "offset": 0, "length": 1}"#),
    ("/v1/recordings/digest", r#"{"name": "x", "file": "session.toml"}"#),
    ("/v1/controls", r#"{"camera": "x", "name": "gain", "value": 1}"#),
    ("/v1/controls/revert", r#"{"camera": "x"}"#),
    ("/v1/controls/save", r#"{"fingerprint": "x"}"#),
];

#[test]
fn every_answer_of_a_live_server_fits_the_document() {
    let served = served();
    let document = Document::new(serde_json::from_str(OPENAPI).unwrap());
    let mut seen = BTreeSet::new();
    let mut check = |method: &str, path: &str, answer: &Answer, wanted: u16| {
        assert_eq!(answer.status, wanted, "{method} {path}: {}", answer.body);
        document.check_answer(method, path, answer.status, &answer.media_type(), &answer.body);
        seen.insert((method.to_owned(), path.to_owned()));
    };
    for path in ["/v1/record", "/v1/record/losses", "/v1/episodes"] {
        check("GET", path, &served.get(path), 200);
        assert_eq!(served.get(path).json(), Value::Null);
    }
    check("GET", "/v1/status", &served.get("/v1/status"), 200);
    check("POST", "/v1/record/stop", &served.post("/v1/record/stop", ""), 409);
    check("POST", "/v1/record/note", &served.post("/v1/record/note", r#"{"text": "x"}"#), 409);
    check("POST", "/v1/record/start", &served.post("/v1/record/start", r#"{"scene": "table"}"#), 200);
    check("POST", "/v1/record/start", &served.post("/v1/record/start", "{}"), 409);
    check("GET", "/v1/status", &served.get("/v1/status"), 200);
    for path in ["/v1/record", "/v1/record/losses", "/v1/episodes"] {
        check("GET", path, &served.get(path), 200);
    }
    check("POST", "/v1/record/note", &served.post("/v1/record/note", r#"{"text": "lamp on"}"#), 204);
    check("POST", "/v1/record/note", &served.post("/v1/record/note", r#"{"text": ""}"#), 400);
    for (body, status) in EPISODES {
        check("POST", "/v1/episode", &served.post("/v1/episode", body), status);
    }
    check("POST", "/v1/record/stop", &served.post("/v1/record/stop", ""), 200);
    check("GET", "/v1/calibration", &served.get("/v1/calibration"), 200);
    check("GET", "/v1/health", &served.get("/v1/health"), 503);
    served.fake.set_all(CameraState::Streaming);
    check("GET", "/v1/health", &served.get("/v1/health"), 200);
    check("GET", "/v1/config", &served.get("/v1/config"), 200);
    check("GET", "/metrics", &served.get("/metrics"), 200);
    // This rig has neither cameras nor a folder; tests/python/test_live_rig.py has answers of one that does.
    for path in ["/v1/recordings", "/v1/doctor", "/v1/controls", "/v1/controls/changes"] {
        check("GET", path, &served.get(path), 409);
    }
    check("GET", "/v1/recordings/image", &served.get("/v1/recordings/image?name=x"), 409);
    check("GET", "/v1/recordings/image", &served.get("/v1/recordings/image"), 400);
    // A connection that has changed its protocol has left HTTP; daemon/src/mirror has tests of it.
    let frames = "/v1/frames/{camera}/{stream}";
    check("GET", frames, &served.get("/v1/frames/top/color"), 400);
    check("GET", frames, &served.get("/v1/frames/top/Color%20"), 400);
    let over_port = served.on_port(&request("GET", "/v1/frames/top/color", "localhost", None, ""));
    check("GET", frames, &over_port, 403);
    check("GET", "/v1/report/{ticket}", &served.get("/v1/report/0123"), 404);
    for (path, body) in WITHOUT_CAMERAS {
        check("POST", path, &served.post(path, body), 409);
        check("POST", path, &served.post(path, r#"{"unknown": 1}"#), 400);
    }
    check("POST", "/v1/record/stop", &served.post("/v1/record/stop", r#"{"mark": "ugly"}"#), 400);
    check("GET", "/v1/page", &served.get("/v1/page"), 200);
    check("GET", "/v1/openapi.json", &served.get("/v1/openapi.json"), 200);
    for (kind, wanted) in [
        (ErrorKind::NotFound, 404),
        (ErrorKind::NoSpace, 507),
        (ErrorKind::PermissionDenied, 403),
        (ErrorKind::Other, 500),
    ] {
        served.fake.fail_next(kind, "as scripted");
        let answer = served.post("/v1/record/start", "{}");
        check("POST", "/v1/record/start", &answer, wanted);
        assert_eq!(answer.json()["error"]["message"], "as scripted");
    }
    for call in ["pause", "resume", "seek", "step", "rate", "loop"] {
        let path = format!("/v1/replay/{call}");
        let body = match call {
            "rate" => r#"{"rate": 2}"#,
            "loop" => r#"{"on": true}"#,
            _ => "{}",
        };
        if call == "pause" {
            check("GET", "/v1/replay", &served.get("/v1/replay"), 409);
            check("POST", &path, &served.post(&path, body), 409);
            served.fake.become_replay();
            check("GET", "/v1/replay", &served.get("/v1/replay"), 200);
            check("GET", "/v1/status", &served.get("/v1/status"), 200);
        }
        check("POST", &path, &served.post(&path, body), 200);
        check(
            "POST",
            &path,
            &served.post(&path, r#"{"unknown": 1}"#),
            if body == "{}" && !["seek", "step"].contains(&call) { 200 } else { 400 },
        );
        served.fake.fail_next(ErrorKind::WrongState, "as scripted");
        check("POST", &path, &served.post(&path, body), 409);
    }
    check("GET", "/v1/replay", &served.get("/v1/replay"), 200);
    served.fake.fail_next(ErrorKind::NotFound, "as scripted");
    check("POST", "/v1/replay/seek", &served.post("/v1/replay/seek", r#"{"id": 9}"#), 404);
    let events = "/v1/calibration/events";
    check("POST", events, &served.post(events, &capture_event(3).to_string()), 204);
    check("POST", events, &served.post(events, "{}"), 400);
    let following: Vec<_> = (0..MAX_FOLLOWERS).map(|_| served.follow()).collect();
    check("GET", events, &served.get(events), 503);
    drop(following);
    check("POST", "/v1/stop", &served.post("/v1/stop", ""), 202);
    assert!(served.fake.stop_was_asked());
    let all: BTreeSet<_> = ROUTES.iter().map(|r| (r.method.to_owned(), r.path.to_owned())).collect();
    assert_eq!(seen, all, "a route was not tried");
}

/// An event as a capture makes it, after so many views.
fn capture_event(views: u64) -> Value {
    let hint = json!({"text": "to the left of front's image, at 0.5 m", "camera": "front", "seen_by": ["front"],
        "outline": [[0.1, 0.2], [0.3, 0.2], [0.3, 0.4], [0.1, 0.4]], "distance_m": 0.5, "tilt": "top_away", "gain": 0.1});
    let camera = json!({"name": "front", "corners": 54, "at": [[0.1, 0.2]], "views": views, "coverage": [0, 3],
        "coverage_columns": 2, "worst_px": 0.4, "missing": ["1 of 10 views"]});
    let progress = json!({"state": "hold_still", "views": views, "cameras": [camera],
        "pairs": [{"a": "front", "b": "side", "shared": 2, "missing": 1}], "missing": [], "hint": hint});
    json!({"utc_ns": 1, "out": "views", "is_finished": false, "refused": [], "progress": progress})
}

/// The lines that a follower reads.
struct Following(std::io::BufReader<UnixStream>);

impl Following {
    /// The next line that is not empty.
    fn line(&mut self) -> String {
        loop {
            let mut line = String::new();
            let read = std::io::BufRead::read_line(&mut self.0, &mut line).unwrap();
            assert!(read > 0, "the answer ended");
            // Chunks of the answer begin with their length.
            if line.starts_with("data: ") || line.starts_with("HTTP/") {
                return line.trim_end().to_owned();
            }
        }
    }

    fn event(&mut self) -> Value {
        serde_json::from_str(self.line().strip_prefix("data: ").unwrap()).unwrap()
    }
}

impl Served {
    fn follow(&self) -> Following {
        let mut stream = self.unix();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.write_all(b"GET /v1/calibration/events HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
        let mut following = Following(std::io::BufReader::new(stream));
        assert_eq!(following.line(), "HTTP/1.1 200 OK");
        following
    }
}

#[test]
fn events_of_a_calibration_reach_those_who_follow() {
    let served = served();
    let document = Document::new(serde_json::from_str(OPENAPI).unwrap());
    let mut early = served.follow();
    let post = |views| served.post("/v1/calibration/events", &capture_event(views).to_string()).status;
    assert_eq!(post(1), 204);
    assert_eq!(early.event(), capture_event(1));
    document.check_value("CaptureEvent", &capture_event(1));
    let mut late = served.follow();
    assert_eq!(late.event(), capture_event(1), "one who comes late gets the last one");
    assert_eq!(post(2), 204);
    assert_eq!(early.event(), capture_event(2));
    assert_eq!(late.event(), capture_event(2));
    // One who does not read holds up nobody, and gets the latest.
    for views in 3..200 {
        assert_eq!(post(views), 204);
    }
    let mut last = early.event();
    while last["progress"]["views"] != json!(199) {
        last = early.event();
    }
    // A field that is not known is refused with its name, and changes nothing.
    let mut wrong = capture_event(7);
    wrong["progress"]["cameras"][0]["corners"] = json!("many");
    let refused = served.post("/v1/calibration/events", &wrong.to_string());
    assert_eq!(refused.status, 400);
    assert!(refused.body.contains("many"), "{}", refused.body);
    assert_eq!(served.follow().event(), capture_event(199));
    // Places come back, and the end of the service ends the answer.
    for _ in 0..3 * MAX_FOLLOWERS {
        drop(served.follow());
        std::thread::sleep(Duration::from_millis(20));
    }
    let mut last = served.follow();
    last.event();
    served.server.stop();
    let mut rest = String::new();
    std::io::Read::read_to_string(&mut last.0, &mut rest).unwrap();
}

#[test]
fn what_is_asked_arrives() {
    let served = served();
    let body = r#"{"directory": "/data", "name": "n", "scene": "s", "operator": "o", "notes": "a\nb",
        "max_duration_s": 90.5, "force": true}"#;
    assert_eq!(served.post("/v1/record/start", body).status, 200);
    let request = RecordRequest {
        directory: Some("/data".into()),
        name: Some("n".into()),
        scene: "s".into(),
        operator: "o".into(),
        notes: "a\nb".into(),
        max_duration_s: Some(90.5),
        force: true,
    };
    assert_eq!(served.fake.last_request(), Some(request));
    assert_eq!(served.get("/v1/episodes").json()["episodes"][0]["outcome"], "failure");
    assert_eq!(served.get("/v1/config").body, fake::CONFIG);
    assert!(served.get("/metrics").body.contains("depthrig_sets_sent_total 7\n"));
    let health = served.get("/v1/health").json();
    let reason = json!({"camera": "d405", "state": "reconnecting", "message": "unplugged"});
    assert_eq!(health, json!({"healthy": false, "reasons": [reason]}));
}

#[test]
fn a_client_steers_a_replay() {
    let served = served();
    let client = Client::connect(&served.runtime, None).unwrap();
    let e = client.replay().unwrap_err();
    assert_eq!(e.kind(), ErrorKind::WrongState);
    assert!(e.to_string().contains("is not a replay"), "{e}");
    served.fake.become_replay();
    assert_eq!(client.replay().unwrap().set, None);
    client.replay_pause().unwrap();
    client.replay_resume().unwrap();
    client.replay_seek(&SeekRequest { seconds: Some(0.1), ..SeekRequest::default() }).unwrap();
    client.replay_seek(&SeekRequest { set: Some(3), ..SeekRequest::default() }).unwrap();
    client.replay_step(-2).unwrap();
    client.replay_rate(0.1).unwrap();
    assert_eq!(client.replay_loop(true).unwrap().set, Some(7));
    assert_eq!(served.post("/v1/replay/step", "").status, 200);
    assert_eq!(
        served.fake.replay_calls(),
        [
            "pause",
            "resume",
            "SeekRequest { seconds: Some(0.1), set: None, id: None }",
            "SeekRequest { seconds: None, set: Some(3), id: None }",
            "step -2",
            "rate 0.1",
            "loop true",
            "step 1",
        ]
    );
    assert_eq!(client.status().unwrap().replay.unwrap().position_s, 1.5);
}

#[test]
fn requests_that_make_no_sense_are_told_so() {
    let served = served();
    let error = |answer: &Answer, status: u16, kind: &str, says: &str| {
        assert_eq!(answer.status, status, "{}", answer.body);
        assert_eq!(answer.media_type(), "application/json");
        assert_eq!(answer.json()["error"]["kind"], kind);
        let message = answer.json()["error"]["message"].as_str().unwrap().to_owned();
        assert!(message.contains(says), "{message}");
    };
    error(&served.get("/v1/nothing"), 404, "not_found", "there is no /v1/nothing; there are /v1/status");
    error(&served.get("/v2/status"), 404, "not_found", "/v1/status");
    error(&served.post("/v1/status", ""), 405, "bad_input", "answers to GET, not to POST");
    error(&served.get("/v1/stop"), 405, "bad_input", "answers to POST, not to GET");
    assert!(!served.fake.stop_was_asked());
    error(&served.post("/v1/record/start", "{"), 400, "bad_input", "EOF");
    error(&served.post("/v1/record/start", r#"{"scen": "x"}"#), 400, "bad_input", "unknown field `scen`");
    error(&served.post("/v1/record/note", "{}"), 400, "bad_input", "missing field `text`");
    error(&served.post("/v1/record/note", r#"{"text": 3}"#), 400, "bad_input", "invalid type");
    let long = format!(r#"{{"text": "{}"}}"#, "x".repeat(MAX_BODY_BYTES));
    error(&served.post("/v1/record/note", &long), 413, "bad_input", "body");
    let fits = format!(r#"{{"text": "{}"}}"#, "x".repeat(MAX_BODY_BYTES - 20));
    assert_eq!(
        served.post("/v1/record/note", &fits).status,
        409,
        "read, then refused for want of a recording"
    );
    served.fake.panic_next();
    error(&served.post("/v1/record/start", "{}"), 500, "other", "failed inside the daemon");
    assert_eq!(served.get("/v1/status").status, 200, "a call that failed inside takes nothing with it");
}

#[test]
fn web_pages_are_kept_out() {
    let served = served();
    let get = |host: &str| served.on_port(&request("GET", "/v1/status", host, None, ""));
    for host in ["localhost", "127.0.0.1:8642", "[::1]:80"] {
        assert_eq!(get(host).status, 200, "{host}");
    }
    for host in ["evil.example", "127.0.0.1.evil.example:80", "192.168.1.4"] {
        let answer = get(host);
        assert_eq!(
            (answer.status, answer.json()["error"]["kind"].as_str()),
            (403, Some("permission_denied")),
            "{host}"
        );
    }
    let two = "GET /v1/status HTTP/1.1\r\nhost: localhost\r\nhost: evil.example\r\nconnection: close\r\n\r\n";
    assert!(served.on_port(two).status >= 400);
    let none = "GET /v1/status HTTP/1.0\r\n\r\n";
    assert_eq!(served.on_port(none).status, 403);
    // Types that a page of another origin may send without permission, and none at all.
    let simple = [
        "text/plain",
        "application/x-www-form-urlencoded",
        "multipart/form-data",
        "text/plain;application/json",
    ];
    for kind in simple.map(Some).into_iter().chain([None]) {
        for answer in [
            served.on_port(&request("POST", "/v1/stop", "localhost", kind, "{}")),
            exchange(served.unix(), request("POST", "/v1/stop", "localhost", kind, "{}").as_bytes()),
        ] {
            assert_eq!(answer.status, 415, "{kind:?}");
            assert!(answer.body.contains("Content-Type: application/json"), "{}", answer.body);
        }
    }
    assert!(!served.fake.stop_was_asked());
    // The question that a browser asks first for JSON is not answered with leave.
    let preflight = served.on_port(&request("OPTIONS", "/v1/stop", "localhost", None, ""));
    assert_eq!(preflight.status, 405);
    assert!(!preflight.head.contains("access-control"));
    let good = request("POST", "/v1/stop", "localhost", Some("application/json; charset=utf-8"), "");
    assert_eq!(served.on_port(&good).status, 202);
    assert!(served.fake.stop_was_asked());
}

#[test]
fn the_socket_is_private_and_goes_with_the_server() {
    let served = served();
    let path = served.runtime.socket_path(&served.rig);
    assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    served.server.stop();
    assert!(!path.exists());
}

#[test]
fn a_dead_daemons_socket_is_replaced_and_nothing_else_is() {
    let tmp = tempfile::tempdir().unwrap();
    let runtime = RuntimeDir::at(tmp.path()).unwrap();
    let rig = RigName::new("r").unwrap();
    let path = runtime.socket_path(&rig);
    let fake: Arc<Fake> = Arc::default();
    drop(UnixListener::bind(&path).unwrap());
    assert!(path.exists(), "a socket that nobody listens on");
    let first = api::serve(fake.clone(), &runtime, &rig, tcp(Port::Off)).unwrap();
    let e = api::serve(fake.clone(), &runtime, &rig, tcp(Port::Off)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::InUse);
    assert!(e.to_string().contains("another process answers on it"), "{e}");
    // A server whose file was replaced by somebody leaves that file alone.
    std::fs::remove_file(&path).unwrap();
    let second = api::serve(fake.clone(), &runtime, &rig, tcp(Port::Off)).unwrap();
    let inode = std::fs::metadata(&path).unwrap().ino();
    first.stop();
    assert_eq!(std::fs::metadata(&path).unwrap().ino(), inode);
    second.stop();
    std::fs::write(&path, "precious").unwrap();
    let e = api::serve(fake, &runtime, &rig, tcp(Port::Off)).unwrap_err();
    assert!(e.to_string().contains("a file that is not a socket is in the way"), "{e}");
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "precious");
}

#[test]
fn ports_that_cannot_be_served_say_why() {
    let tmp = tempfile::tempdir().unwrap();
    let runtime = RuntimeDir::at(tmp.path()).unwrap();
    let rig = RigName::new("r").unwrap();
    let path = runtime.socket_path(&rig);
    let serve = |address: SocketAddr| {
        api::serve(Arc::<Fake>::default(), &runtime, &rig, tcp(Port::At(address))).unwrap_err()
    };
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let e = serve(taken.local_addr().unwrap());
    assert_eq!(e.kind(), ErrorKind::InUse);
    assert!(e.to_string().contains("another program listens there"), "{e}");
    let e = serve("0.0.0.0:0".parse().unwrap());
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert!(e.to_string().contains("not loopback"), "{e}");
    assert!(!path.exists(), "a start that failed leaves no socket");
}

#[test]
fn the_end_does_not_wait_for_slow_clients_or_slow_calls() {
    let served = served();
    let mut idle = served.unix();
    let mut half = served.unix();
    half.write_all(b"POST /v1/record/note HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 50\r\n\r\n{").unwrap();
    served.fake.delay(Duration::from_secs(3));
    let mut slow = served.unix();
    slow.write_all(request("POST", "/v1/record/start", "localhost", Some("application/json"), "").as_bytes())
        .unwrap();
    served.fake.wait_for_call();
    let begin = HostTime::now();
    served.server.stop();
    let took = begin.elapsed();
    assert!(took < Duration::from_millis(2500), "{took:?}");
    let mut rest = Vec::new();
    assert_eq!(idle.read_to_end(&mut rest).unwrap_or(0), 0);
}

#[test]
fn a_slow_call_does_not_make_others_wait_and_idle_connections_leave_room() {
    let served = served();
    let _idle: Vec<_> = (0..api::MAX_CONNECTIONS - 2).map(|_| served.unix()).collect();
    served.fake.delay(Duration::from_secs(2));
    let mut slow = served.unix();
    slow.write_all(request("POST", "/v1/record/start", "localhost", Some("application/json"), "").as_bytes())
        .unwrap();
    served.fake.wait_for_call();
    let begin = HostTime::now();
    assert_eq!(served.get("/v1/status").status, 200);
    assert!(begin.elapsed() < Duration::from_millis(1500));
}

#[test]
fn the_client_says_and_hears_everything() {
    let served = served();
    let client = Client::connect(&served.runtime, None).unwrap();
    assert_eq!(client.rig().as_str(), "mount");
    assert_eq!(client.status().unwrap(), served.fake.current());
    assert_eq!(client.config().unwrap(), fake::CONFIG);
    assert_eq!(client.record_status().unwrap(), None);
    let request = RecordRequest { scene: "table".into(), ..RecordRequest::default() };
    let started = client.record_start(&request).unwrap();
    assert!(started.active && started.scene == "table");
    assert_eq!(served.fake.last_request(), Some(request.clone()));
    assert_eq!(client.record_status().unwrap(), Some(started));
    client.record_note("lamp \u{1f4a1} on").unwrap();
    assert_eq!(served.fake.notes(), ["lamp \u{1f4a1} on"]);
    let e = client.record_start(&request).unwrap_err();
    assert_eq!((e.kind(), e.to_string().as_str()), (ErrorKind::InUse, "a recording goes on already"));
    assert!(!client.record_stop().unwrap().active);
    for kind in [
        ErrorKind::BadInput,
        ErrorKind::NotFound,
        ErrorKind::InUse,
        ErrorKind::WrongState,
        ErrorKind::NoSpace,
        ErrorKind::PermissionDenied,
        ErrorKind::Unreachable,
        ErrorKind::Other,
    ] {
        served.fake.fail_next(kind, "as scripted");
        let e: Error = client.record_start(&request).unwrap_err();
        assert_eq!((e.kind(), e.to_string().as_str()), (kind, "as scripted"));
    }
    client.stop().unwrap();
    assert!(served.fake.stop_was_asked());
    let Served { server, lock, .. } = served;
    server.stop();
    let e = client.status().unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Unreachable);
    assert!(e.to_string().contains("runs (process 42 (rig.toml)) but has no control socket"), "{e}");
    drop(lock);
    let e = client.status().unwrap_err();
    assert!(e.to_string().contains("rig \"mount\" has ended"), "{e}");
}

#[test]
fn the_client_says_what_is_missing() {
    let tmp = tempfile::Builder::new().prefix("dr").rand_bytes(4).tempdir_in("/tmp").unwrap();
    let runtime = RuntimeDir::at(tmp.path()).unwrap();
    let a = RigName::new("a").unwrap();
    let b = RigName::new("b").unwrap();
    let fails = |rig: Option<&RigName>, kind: ErrorKind, says: &str| {
        let e = Client::connect(&runtime, rig).unwrap_err();
        assert_eq!(e.kind(), kind, "{e}");
        assert!(e.to_string().contains(says), "{e}");
    };
    fails(None, ErrorKind::Unreachable, "start one: depthrig run RIG.toml");
    fails(Some(&a), ErrorKind::Unreachable, "rig \"a\" does not run, nor does any other");
    let lock_a = runtime.lock(&a, "process 7 (a.toml)").unwrap();
    fails(Some(&b), ErrorKind::Unreachable, "rig \"b\" does not run; these do: a");
    fails(None, ErrorKind::Unreachable, "rig \"a\" runs (process 7 (a.toml)) but has no control socket");
    drop(UnixListener::bind(runtime.socket_path(&a)).unwrap());
    fails(Some(&a), ErrorKind::Unreachable, "nothing answers on");
    let lock_b = runtime.lock(&b, "process 8").unwrap();
    fails(None, ErrorKind::BadInput, "several rigs run: a, b; say which one");
    drop((lock_a, lock_b));
}

/// A daemon of another version, one that answers nonsense, and one that hangs up.
#[test]
fn strange_daemons_are_named() {
    let tmp = tempfile::Builder::new().prefix("dr").rand_bytes(4).tempdir_in("/tmp").unwrap();
    let runtime = RuntimeDir::at(tmp.path()).unwrap();
    let rig = RigName::new("a").unwrap();
    let _lock = runtime.lock(&rig, "process 7").unwrap();
    let listener = UnixListener::bind(runtime.socket_path(&rig)).unwrap();
    let answers = [
        (
            "HTTP/1.1 200 OK\r\nserver: depthrig/99.0.0\r\ncontent-length: 0\r\n\r\n",
            ErrorKind::Other,
            "of version 99.0.0, this program of",
        ),
        ("HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n", ErrorKind::Other, "of version ?"),
        ("SSH-2.0-OpenSSH\r\n", ErrorKind::Unreachable, "broke off"),
        ("", ErrorKind::Unreachable, "broke off"),
    ];
    let texts = answers.map(|(text, ..)| text);
    let daemon = std::thread::spawn(move || {
        for text in texts {
            let (mut stream, _) = listener.accept().unwrap();
            let mut head = [0; 4096];
            let _ = stream.read(&mut head).unwrap();
            stream.write_all(text.as_bytes()).unwrap();
        }
    });
    for (text, kind, says) in answers {
        let e = Client::connect(&runtime, Some(&rig)).unwrap_err();
        assert_eq!(e.kind(), kind, "{text}: {e}");
        assert!(e.to_string().contains(says), "{text}: {e}");
    }
    daemon.join().unwrap();
}
