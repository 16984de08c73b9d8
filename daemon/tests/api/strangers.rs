//! Other users of the computer, who reach the port: they control nothing and keep nobody waiting.

use super::*;

/// The head of a POST whose body does not come, with a token or without.
fn half_a_post(token: Option<&str>) -> String {
    let token = token.map(|t| format!("authorization: Bearer {t}\r\n")).unwrap_or_default();
    format!(
        "POST /v1/record/note HTTP/1.1\r\nhost: localhost\r\n{token}content-type: application/json\r\ncontent-length: \
         50\r\n\r\n{{"
    )
}

#[test]
fn half_sent_bodies_on_the_port_do_not_keep_the_socket_waiting() {
    let served = served();
    let token = served.token();
    let mut halves: Vec<TcpStream> = (0..api::MAX_CONNECTIONS).map(|_| served.port()).collect();
    for half in &mut halves {
        half.write_all(half_a_post(Some(&token)).as_bytes()).unwrap();
    }
    assert_eq!(served.get("/v1/status").status, 200);
    let waits = |half: &TcpStream| {
        half.set_nonblocking(true).unwrap();
        let peeked = half.peek(&mut [0]);
        half.set_nonblocking(false).unwrap();
        peeked.is_err_and(|e| e.kind() == std::io::ErrorKind::WouldBlock)
    };
    assert!(halves.iter().all(waits), "they were cut off before the socket answered");
    // None waits for ever, and the port answers again.
    let begin = HostTime::now();
    for half in halves {
        half.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
        assert_eq!(exchange_rest(half).status, 408);
    }
    assert!(begin.elapsed() < Duration::from_mins(1));
    assert_eq!(served.on_port(&request("GET", "/v1/status", "localhost", None, "")).status, 200);
}

/// Reads the rest of a connection.
fn exchange_rest(stream: TcpStream) -> Answer {
    exchange(stream, b"")
}

#[test]
fn idle_connections_on_the_port_leave_the_sockets_places_free_and_end() {
    let served = served();
    let idle: Vec<_> = (0..2 * api::MAX_CONNECTIONS).map(|_| served.port()).collect();
    let mut waiting = served.port();
    waiting.write_all(request("GET", "/metrics", "localhost", None, "").as_bytes()).unwrap();
    waiting.set_read_timeout(Some(Duration::from_millis(300))).unwrap();
    let e = waiting.read(&mut [0]).expect_err("the port has a place left");
    assert_eq!(e.kind(), std::io::ErrorKind::WouldBlock);
    assert_eq!(served.get("/v1/status").status, 200);
    // Who sends no head is not waited for: those before this one, and then those before them, have ended.
    waiting.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
    assert_eq!(exchange_rest(waiting).status, 200);
    drop(idle);
}

#[test]
fn without_the_token_the_port_serves_numbers_and_nothing_else() {
    let served = served();
    let token = served.token();
    let path = served.server.token_path().unwrap().to_owned();
    assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    let wrong = token.replace(|c: char| c != '0', "0");
    let lines = [
        String::new(),
        format!("authorization: Bearer {wrong}\r\n"),
        format!("authorization: Bearer {}\r\n", &token[1..]),
        format!("authorization: Bearer {token}0\r\n"),
        format!("authorization: Basic {token}\r\n"),
        format!("authorization: {token}\r\n"),
        format!("authorization: Bearer {wrong}\r\nauthorization: Bearer {token}\r\n"),
        format!("authorization: Bearer {token}\r\nauthorization: Bearer {wrong}\r\n"),
    ];
    let bare = |method: &str, path: &str, line: &str| {
        let text = request(method, path, "localhost", Some("application/json"), "{}");
        exchange(served.port(), text.replacen("\r\n", &format!("\r\n{line}"), 1).as_bytes())
    };
    // The address of a report is a secret of its own, and this is none.
    let is_report = |r: &&api::Route| r.path.starts_with("/v1/report/");
    let (reports, others): (Vec<&api::Route>, Vec<&api::Route>) = ROUTES.iter().partition(is_report);
    assert_eq!(reports.len(), 1);
    assert_eq!(bare("GET", "/v1/report/0123", "").status, 404);
    for route in others {
        for line in &lines {
            let answer = bare(route.method, route.path, line);
            let open = route.path == "/metrics";
            assert_eq!(answer.status, if open { 200 } else { 401 }, "{} {line}: {}", route.path, answer.body);
            if !open {
                assert_eq!(answer.json()["error"]["kind"], "permission_denied");
                assert!(
                    answer.body.contains(path.to_str().unwrap()),
                    "it says where the token is: {}",
                    answer.body
                );
                assert!(!answer.body.contains(&token));
            }
        }
    }
    assert!(!served.fake.stop_was_asked() && served.fake.last_request().is_none());
    // A body that does not come is not waited for.
    assert_eq!(exchange(served.port(), half_a_post(None).as_bytes()).status, 401);
    assert_eq!(bare("POST", "/v1/stop", &format!("authorization: bearer {token}\r\n")).status, 202);
    served.server.stop();
    assert!(!path.exists(), "the token goes with the server");
}

#[test]
fn a_recording_goes_only_where_the_rig_allows_it() {
    let served = served();
    let home = tempfile::tempdir().unwrap();
    let home = home.path().canonicalize().unwrap();
    let data = home.join("data");
    std::fs::create_dir(&data).unwrap();
    std::fs::create_dir(home.join("private")).unwrap();
    std::os::unix::fs::symlink(home.join("private"), data.join("link")).unwrap();
    served.fake.set_roots(&[&data]);
    let ask = |directory: &str| {
        let body = json!({ "directory": home.join(directory) }).to_string();
        let answer = served.post("/v1/record/start", &body);
        let text = request("POST", "/v1/record/start", "localhost", Some("application/json"), &body);
        let on_port = served.on_port(&text);
        (answer, on_port)
    };
    for bad in ["private", "data/../private", "data/link", "data/link/deeper", "data/new/../../private"] {
        let (answer, on_port) = ask(bad);
        assert_eq!((answer.status, on_port.status), (403, 403), "{bad}: {}", answer.body);
        let message = answer.json()["error"]["message"].as_str().unwrap().to_owned();
        assert!(message.contains("recording.allow") && message.contains(data.to_str().unwrap()), "{message}");
    }
    assert_eq!(served.fake.last_request(), None);
    assert_eq!(ask("data/new").0.status, 200);
    assert_eq!(served.fake.last_request().unwrap().directory, Some(data.join("new")));
}
