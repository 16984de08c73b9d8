//! A server on this computer that does what servers do: points elsewhere, breaks off, ignores ranges, lies.

use super::*;
use core::ops::ControlFlow;
use core::sync::atomic::{AtomicUsize, Ordering};
use std::fmt::Write as _;
use std::io::{BufRead, BufReader};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

/// A request: its path and headers, lower case.
#[derive(Debug, Clone)]
struct Request {
    path: String,
    headers: Vec<(String, String)>,
}

impl Request {
    fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
    }

    /// The first byte that is asked for.
    fn from(&self) -> usize {
        let range = self.header("range").and_then(|r| r.strip_prefix("bytes=")?.strip_suffix('-'));
        range.map_or(0, |n| n.parse().unwrap())
    }
}

type Handler = dyn Fn(usize, &Request) -> Vec<u8> + Send + Sync;

/// Answers each connection by `handler`, which is given its number, and closes it.
struct Server {
    address: String,
    requests: Arc<Mutex<Vec<Request>>>,
}

impl Server {
    fn new(handler: impl Fn(usize, &Request) -> Vec<u8> + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let requests = Arc::new(Mutex::new(Vec::new()));
        let seen = Arc::clone(&requests);
        let handler: Arc<Handler> = Arc::new(handler);
        let count = AtomicUsize::new(0);
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                answer(stream, &seen, &*handler, count.fetch_add(1, Ordering::Relaxed));
            }
        });
        Self { address, requests }
    }

    fn requests(&self) -> Vec<Request> {
        self.requests.lock().unwrap().clone()
    }
}

fn answer(mut stream: TcpStream, seen: &Mutex<Vec<Request>>, handler: &Handler, n: usize) {
    let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
    let Some(Ok(first)) = lines.next() else { return };
    let path = first.split(' ').nth(1).unwrap_or_default().to_owned();
    let mut headers = Vec::new();
    for line in lines.map_while(Result::ok).take_while(|l| !l.is_empty()) {
        let (name, value) = line.split_once(": ").unwrap();
        headers.push((name.to_lowercase(), value.to_owned()));
    }
    let request = Request { path, headers };
    seen.lock().unwrap().push(request.clone());
    drop(stream.write_all(&handler(n, &request)));
}

fn reply(status: &str, headers: &[(&str, String)], body: &[u8]) -> Vec<u8> {
    let mut text = format!("HTTP/1.1 {status}\r\nConnection: close\r\n");
    for (name, value) in headers {
        let _ = write!(text, "{name}: {value}\r\n");
    }
    [text.as_bytes(), b"\r\n", body].concat()
}

/// The file as a good server sends it, but for what `cut` leaves of each body.
fn part(request: &Request, file: &[u8], etag: &str, cut: usize) -> Vec<u8> {
    let from = request.from();
    let fresh = request.header("if-range").is_none_or(|e| e == etag);
    let tag = ("ETag", etag.to_owned());
    if from > 0 && fresh {
        let rest = &file[from..];
        let range = ("Content-Range", format!("bytes {from}-{}/{}", file.len() - 1, file.len()));
        let length = ("Content-Length", rest.len().to_string());
        return reply("206 Partial Content", &[range, length, tag], &rest[..rest.len().min(cut)]);
    }
    reply("200 OK", &[("Content-Length", file.len().to_string()), tag], &file[..file.len().min(cut)])
}

fn made_up(len: usize) -> Vec<u8> {
    (0..len).map(|i| (i * i / 7) as u8).collect()
}

fn hash(bytes: &[u8]) -> String {
    durable::hex(&Sha256::digest(bytes))
}

struct Setup {
    _dir: tempfile::TempDir,
    store: ModelStore,
}

fn setup() -> Setup {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    Setup { _dir: dir, store }
}

fn options(server: &Server) -> FetchOptions {
    FetchOptions {
        endpoint: Some(server.address.clone()),
        wait: Duration::from_millis(1),
        retries: 3,
        ..FetchOptions::default()
    }
}

fn quiet(_: &'static str, _: u64, _: u64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn failed(s: &Setup, name: &str, options: &FetchOptions) -> String {
    let e = fetch(&s.store, name, options, &mut quiet).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Network, "{e}");
    e.to_string()
}

const NAME: &str = "cdm-d435";

/// As `huggingface.co`: the first server names size, hash and version and points to the one with the file, which breaks
/// off three times.
#[test]
fn a_cut_download_goes_on_where_it_ended() {
    let s = setup();
    let file = made_up(1_000_000);
    let copy = file.clone();
    let files = Server::new(move |_, r| part(r, &copy, "\"v1\"", 300_000));
    let linked = [
        ("Location", format!("{}/signed?x=1", files.address)),
        ("X-Linked-Etag", format!("\"{}\"", hash(&file))),
        ("X-Linked-Size", file.len().to_string()),
        ("X-Repo-Commit", "e6aa46d8".to_owned()),
    ];
    let hub = Server::new(move |_, _| reply("302 Found", &linked, b""));
    let options = FetchOptions { token: Some("secret".into()), retries: 1, ..options(&hub) };
    let fetched = fetch(&s.store, NAME, &options, &mut quiet).unwrap();
    assert_eq!(std::fs::read(&fetched.path).unwrap(), file);
    let expected = Source::Fetched {
        url: format!("{}/depth-anything/camera-depth-model-d435/resolve/main/cdm_d435.ckpt", hub.address),
        revision: Some("e6aa46d8".into()),
        sha256: hash(&file),
        compared_with: "server".into(),
        bytes: 1_000_000,
        licence: "CC-BY-NC-4.0".into(),
    };
    assert_eq!(fetched.source, expected);
    let asked: Vec<_> = files.requests().iter().map(Request::from).collect();
    assert_eq!(asked, [0, 300_000, 600_000, 900_000]);
    let last = &files.requests()[3];
    assert_eq!((last.header("if-range"), last.path.as_str()), (Some("\"v1\""), "/signed?x=1"));
    // The token goes to the server that was asked, and to no other.
    assert_eq!(hub.requests()[0].header("authorization"), Some("Bearer secret"));
    assert!(files.requests().iter().all(|r| r.header("authorization").is_none()));
    fetched.discard();
    assert!(!fetched.path.exists());
}

#[test]
fn what_was_fetched_before_the_program_ended_is_not_fetched_again() {
    let s = setup();
    let file = made_up(500_000);
    let copy = file.clone();
    // Nothing after the first connection until the third.
    let server = Server::new(move |n, r| match n {
        0 => part(r, &copy, "\"v1\"", 200_000),
        1 => reply("503 Busy", &[], b""),
        _ => part(r, &copy, "\"v1\"", usize::MAX),
    });
    let options = FetchOptions { retries: 1, ..options(&server) };
    let e = failed(&s, NAME, &options);
    assert!(e.contains("200000 bytes are here") && e.contains("it goes on from there"), "{e}");
    let fetched = fetch(&s.store, NAME, &options, &mut quiet).unwrap();
    assert_eq!(std::fs::read(&fetched.path).unwrap(), file);
    assert_eq!(server.requests().iter().map(Request::from).collect::<Vec<_>>(), [0, 200_000, 200_000]);
    let Source::Fetched { compared_with, .. } = fetched.source else { panic!("a file") };
    assert_eq!(compared_with, "nothing", "no hash was known: it is said so");
}

#[test]
fn a_server_that_ignores_ranges_or_has_another_version_sends_all() {
    for etag in ["\"v1\"", "\"v2\""] {
        let s = setup();
        let file = made_up(300_000);
        let copy = file.clone();
        let server = Server::new(move |n, r| match n {
            0 => part(r, &made_up(300_001), "\"v1\"", 100_000),
            1 if etag == "\"v1\"" => {
                part(&Request { headers: Vec::new(), ..r.clone() }, &copy, etag, usize::MAX)
            }
            _ => part(r, &copy, etag, usize::MAX),
        });
        let fetched = fetch(&s.store, NAME, &options(&server), &mut quiet).unwrap();
        assert_eq!(std::fs::read(&fetched.path).unwrap(), file, "{etag}");
        assert_eq!(server.requests().len(), 2);
    }
}

#[test]
fn a_wrong_hash_is_found_before_or_after_and_nothing_is_kept() {
    let s = setup();
    let file = made_up(10_000);
    let copy = file.clone();
    let server = Server::new(move |_, r| part(r, &copy, "\"v\"", usize::MAX));
    let options_ = FetchOptions { sha256: Some(hash(b"other")), ..options(&server) };
    let e = failed(&s, NAME, &options_);
    assert!(e.contains(&hash(&file)) && e.contains(&hash(b"other")) && e.contains("(given)"), "{e}");
    assert!(!s.store.dir().join(".downloads/cdm-d435.part").exists());
    // One of the published hashes is known.
    assert!(failed(&s, "cdm-kinect", &options(&server)).contains("ba2b8899a683876f"), "known");
    let good = FetchOptions { sha256: Some(hash(&file).to_uppercase()), ..options(&server) };
    assert!(fetch(&s.store, NAME, &good, &mut quiet).is_ok());
    // Reported by the server before the first byte.
    let tag = ("X-Linked-Etag", format!("\"{}\"", hash(b"newer")));
    let server =
        Server::new(move |_, _| reply("200 OK", &[tag.clone(), ("Content-Length", "3".into())], b"abc"));
    let e = failed(&s, "cdm-kinect", &options(&server));
    assert!(e.contains("Nothing was fetched") && e.contains("--sha256"), "{e}");
    let bad = FetchOptions { sha256: Some("abc".into()), ..options(&server) };
    assert_eq!(fetch(&s.store, NAME, &bad, &mut quiet).unwrap_err().kind(), ErrorKind::BadInput);
}

#[test]
fn a_wrong_length_from_a_server_is_reported() {
    // Always one byte short of what it says: nothing more comes in three attempts.
    let s = setup();
    let server = Server::new(|_, r| match r.from() {
        0 => reply("200 OK", &[("Content-Length", "101".into())], &made_up(100)),
        n => reply(
            "206 Partial",
            &[("Content-Range", format!("bytes {n}-100/101")), ("Content-Length", "1".into())],
            b"",
        ),
    });
    let e = failed(&s, NAME, &options(&server));
    assert!(e.contains("(100 bytes are here, and nothing more came in 4 attempts)"), "{e}");
    // More than the first server said.
    let s = setup();
    let server = Server::new(|_, _| {
        reply("200 OK", &[("X-Linked-Size", "50".into()), ("Content-Length", "100".into())], &made_up(100))
    });
    let e = failed(&s, NAME, &options(&server));
    assert!(e.contains("said 50 bytes and sent 100"), "{e}");
    // A part that is not the one that was asked for.
    let s = setup();
    let server = Server::new(|n, r| match n {
        0 => part(r, &made_up(1000), "\"v\"", 500),
        1 => reply("206 Partial", &[("Content-Range", "bytes 0-999/1000".into())], &made_up(1000)),
        _ => part(r, &made_up(1000), "\"v\"", usize::MAX),
    });
    let fetched = fetch(&s.store, NAME, &options(&server), &mut quiet).unwrap();
    assert_eq!(std::fs::read(&fetched.path).unwrap(), made_up(1000));
}

#[test]
fn refusals_say_what_to_do_and_are_not_repeated() {
    for (status, headers, said) in [
        ("401 Unauthorized", vec![], "HF_TOKEN"),
        ("403 Forbidden", vec![], "accept the terms"),
        ("404 Not Found", vec![], "there is no such file"),
        ("407 Proxy", vec![], "the proxy wants"),
        ("418 Teapot", vec![], "status 418"),
        ("200 OK", vec![("Content-Type", "text/html; charset=utf-8".to_owned())], "a page, not a file"),
        ("302 Found", vec![], "does not say where"),
        ("302 Found", vec![("Location", "ftp://x".to_owned())], "redirects to the invalid address"),
    ] {
        let s = setup();
        let server = Server::new(move |_, _| reply(status, &headers, b""));
        let e = failed(&s, NAME, &options(&server));
        assert!(e.contains(said) && e.starts_with("http://127.0.0.1"), "{status}: {e}");
        assert_eq!(server.requests().len(), 1, "{status}");
    }
    let s = setup();
    let server = Server::new(|_, _| reply("302 Found", &[("Location", "/again".into())], b""));
    assert!(failed(&s, NAME, &options(&server)).contains("from place to place"));
    let nobody = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let offline = FetchOptions { endpoint: Some(format!("http://{nobody}")), ..FetchOptions::default() };
    let e = failed(&s, NAME, &offline);
    assert!(e.contains("cannot be reached") && e.contains("cdm import FILE"), "{e}");
    for (name, url) in [("nonsense", None), ("a b", None), ("x", Some("ftp://x"))] {
        let options = FetchOptions { url: url.map(Into::into), ..FetchOptions::default() };
        let e = fetch(&s.store, name, &options, &mut quiet).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::BadInput, "{e}");
    }
}

#[test]
fn whoever_watches_may_end_it_and_what_came_is_kept() {
    let s = setup();
    let file = made_up(2_000_000);
    let copy = file.clone();
    let server = Server::new(move |_, r| part(r, &copy, "\"v\"", usize::MAX));
    let mut stop = |_: &'static str, done: u64, total: u64| {
        assert_eq!(total, 2_000_000);
        if done > 500_000 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let e = fetch(&s.store, NAME, &options(&server), &mut stop).unwrap_err();
    assert!(e.to_string().contains("the same command goes on from there"), "{e}");
    let fetched = fetch(&s.store, NAME, &options(&server), &mut quiet).unwrap();
    assert_eq!(std::fs::read(&fetched.path).unwrap(), file);
    assert!(server.requests()[1].from() > 500_000);
}

#[test]
fn two_do_not_fetch_one_model() {
    let s = setup();
    let folder = s.store.dir().join(".downloads");
    std::fs::create_dir_all(&folder).unwrap();
    let lock = File::create(folder.join("cdm-d435.lock")).unwrap();
    flock(&lock, FlockOperation::NonBlockingLockExclusive).unwrap();
    let e = fetch(&s.store, NAME, &FetchOptions::default(), &mut quiet).unwrap_err();
    assert!(e.to_string().contains("another `depthrig cdm fetch`"), "{e}");
}

/// A server that says no length and sends without end, or says one and sends more.
#[test]
fn no_more_is_fetched_than_a_checkpoint_can_have() {
    let endless = Server::new(|_, _| reply("200 OK", &[], &made_up(4 << 20)));
    let large = Server::new(|_, _| {
        reply("200 OK", &[("Content-Length", (1u64 << 60).to_string())], &made_up(1 << 20))
    });
    for (server, said) in [(&endless, "without saying how many"), (&large, "1152921504606846976 bytes")] {
        let Setup { store, .. } = &setup();
        let options = FetchOptions { max_bytes: 1 << 20, ..options(server) };
        let e = fetch(store, "cdm-base", &options, &mut |_, _, _| ControlFlow::Continue(())).unwrap_err();
        assert!(e.kind() == ErrorKind::Network && e.to_string().contains(said), "{e}");
        assert!(e.to_string().contains("depthrig cdm import"), "{e}");
        assert_eq!(server.requests().len(), 1, "it is not tried again");
        let kept = store.dir().join(".downloads/cdm-base.part");
        assert!(!kept.exists(), "and nothing of it is kept");
    }
}
