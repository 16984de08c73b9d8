//! Checkpoints from a server: resumed after a cut, and proven by their hash before anything is done with them.
//!
//! A partial download stays in `.downloads` of the models' folder until it is complete, so that the same command
//! resumes it. Servers of `huggingface.co` report size and SHA-256 of a large file with the first answer
//! (`X-Linked-Size`, `X-Linked-Etag`: `huggingface_hub`, `file_download.py`).

use crate::durable;
use crate::published::Published;
use crate::store::{ModelStore, Source, Watch};
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

mod http;

pub use http::agent;

use http::{Answer, Client};

/// Where the published models are.
const ENDPOINT: &str = "https://huggingface.co";

/// From where, and how patiently.
#[derive(Debug, Clone)]
pub struct FetchOptions {
    /// The server, in place of `https://huggingface.co`: a mirror with the same paths.
    pub endpoint: Option<String>,
    /// The address of the file, in place of that of a published model.
    pub url: Option<String>,
    /// The version of the repository.
    pub revision: String,
    /// Expected SHA-256 of the file, in hexadecimal; overrides the built-in one.
    pub sha256: Option<String>,
    /// Access token for the server; sent to no other host.
    pub token: Option<String>,
    /// Number of retries without any progress in between.
    pub retries: u32,
    /// How long it waits before the first of these; each time twice as long.
    pub wait: Duration,
    /// No more bytes than this are fetched, whatever the server says or leaves unsaid.
    pub max_bytes: u64,
}

/// Three times the largest network with the state of its optimizer beside it.
const MAX_BYTES: u64 = 96 << 30;
/// Room that a file of unknown size leaves on the disk.
const SPARE: u64 = 1 << 30;
/// How much of one is fetched before the room is looked at again.
const LOOK_EVERY: u64 = 64 << 20;

impl Default for FetchOptions {
    fn default() -> Self {
        Self {
            endpoint: None,
            url: None,
            revision: "main".into(),
            sha256: None,
            token: None,
            retries: 5,
            wait: Duration::from_secs(1),
            max_bytes: MAX_BYTES,
        }
    }
}

/// A file that was fetched and has the hash that it should have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fetched {
    /// The file; it goes with [`Self::discard`].
    pub path: PathBuf,
    /// Where it came from.
    pub source: Source,
}

impl Fetched {
    /// Removes the file: the installed model does not need it.
    pub fn discard(&self) {
        forget(&self.path);
    }
}

/// State stored beside an incomplete file.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
struct Progress {
    url: String,
    /// The server's mark of the version of the file.
    etag: Option<String>,
    /// The SHA-256 that the server reported.
    sha256: Option<String>,
}

/// Why one attempt ended.
enum Ended {
    /// It may be tried again.
    Broken(String),
    /// It is of no use to try again.
    Final(Error),
}

impl From<Error> for Ended {
    fn from(e: Error) -> Self {
        Self::Final(e)
    }
}

/// Fetches a published model, or the file at [`FetchOptions::url`], under the name `name`.
///
/// # Errors
/// [`ErrorKind::BadInput`] when it is not known where that name lies, [`ErrorKind::Network`] for everything that a server
/// or the way to it can do, [`ErrorKind::Io`] when the file cannot be written.
pub fn fetch(store: &ModelStore, name: &str, options: &FetchOptions, watch: Watch<'_>) -> Result<Fetched> {
    crate::store::check_name(name)?;
    let published = crate::published::published(name);
    let url = address(name, published, options)?;
    let (known, compared_with) = match (&options.sha256, published.and_then(|p| p.sha256)) {
        (Some(given), _) => (Some(sha256(given)?), "given"),
        (None, Some(known)) if options.url.is_none() => (Some(known.to_owned()), "known"),
        _ => (None, "nothing"),
    };
    let folder = store.dir().join(".downloads");
    depthrig_bus::umask::create_dir_all(&folder).map_err(|e| durable::cannot_write(&folder, e))?;
    let lock = folder.join(format!("{name}.lock"));
    let lock = File::create(&lock).map_err(|e| durable::cannot_write(&lock, e))?;
    flock(&lock, FlockOperation::NonBlockingLockExclusive).map_err(|e| {
        let message = format!("another `depthrig cdm fetch` is fetching {name}; wait for it to end");
        Error::new(ErrorKind::Io, message).with_source(io::Error::from(e))
    })?;
    let mut download = Download {
        path: folder.join(format!("{name}.part")),
        client: Client::new(options.token.clone(), &url),
        url,
        expected: known,
        compared_with,
        revision: None,
        options,
        had: 0,
    };
    download.all(watch)?;
    let (sha256, bytes) = download.proven(watch)?;
    let licence = published.filter(|_| options.url.is_none()).map_or("not known", |p| p.licence);
    let source = Source::Fetched {
        url: download.url,
        revision: download.revision,
        sha256,
        compared_with: download.compared_with.to_owned(),
        bytes,
        licence: licence.to_owned(),
    };
    Ok(Fetched { path: download.path, source })
}

fn address(name: &str, published: Option<&Published>, options: &FetchOptions) -> Result<String> {
    if let Some(url) = &options.url {
        if url.starts_with("https://") || url.starts_with("http://") {
            return Ok(url.clone());
        }
        let message = format!("{url}: not an address of the web, which begins with https://");
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    let Some(p) = published else {
        let names: Vec<_> = crate::published::PUBLISHED.iter().map(|p| p.name).collect();
        let message = format!(
            "no model {name} is published; there are {}. For another file say where it is with --url",
            names.join(", ")
        );
        return Err(Error::new(ErrorKind::BadInput, message));
    };
    let endpoint = options.endpoint.as_deref().unwrap_or(ENDPOINT).trim_end_matches('/');
    Ok(format!("{endpoint}/{}/resolve/{}/{}", p.repository, options.revision, p.file))
}

/// `text` as a SHA-256.
fn sha256(text: &str) -> Result<String> {
    if text.len() == 64 && text.bytes().all(|b| b.is_ascii_hexdigit()) {
        return Ok(text.to_ascii_lowercase());
    }
    let message = format!("invalid SHA-256 {text:?}; it has 64 hexadecimal digits");
    Err(Error::new(ErrorKind::BadInput, message))
}

/// One file on its way.
struct Download<'a> {
    path: PathBuf,
    client: Client,
    url: String,
    expected: Option<String>,
    compared_with: &'static str,
    revision: Option<String>,
    options: &'a FetchOptions,
    /// Bytes that were there when the last attempt ended.
    had: u64,
}

impl Download<'_> {
    /// Until all of it is there.
    fn all(&mut self, watch: Watch<'_>) -> Result<()> {
        let mut failures = 0;
        loop {
            let why = match self.attempt(watch) {
                Ok(()) => return Ok(()),
                Err(Ended::Final(e)) => return Err(e),
                Err(Ended::Broken(why)) => why,
            };
            let has = len(&self.path);
            failures = if has > self.had { 1 } else { failures + 1 };
            self.had = has;
            if failures > self.options.retries {
                let message = format!(
                    "{}: {why} ({has} bytes are here, and nothing more came in {failures} attempts); run the same command \
                     again: it goes on from there",
                    self.url
                );
                return Err(Error::new(ErrorKind::Network, message));
            }
            tracing::info!(url = self.url, "{why}; trying again");
            self.pause(failures, watch)?;
        }
    }

    /// Waits before the next attempt, and sees whether it has to end.
    fn pause(&self, failures: u32, watch: Watch<'_>) -> Result<()> {
        let mut left = self.options.wait * 2_u32.saturating_pow(failures.saturating_sub(1)).min(60);
        while left > Duration::ZERO {
            let part = left.min(Duration::from_millis(100));
            std::thread::sleep(part);
            left -= part;
            if watch("fetch", self.had, self.had.max(1)).is_break() {
                return Err(self.ended());
            }
        }
        Ok(())
    }

    fn ended(&self) -> Error {
        let message = format!(
            "ended before all was fetched; {} bytes are in {}, and the same command goes on from there",
            len(&self.path),
            self.path.display()
        );
        Error::new(ErrorKind::Network, message)
    }

    fn attempt(&mut self, watch: Watch<'_>) -> Result<(), Ended> {
        let before = self.progress();
        let mut has = if before.url == self.url { len(&self.path) } else { 0 };
        let etag = before.etag.as_deref().filter(|e| !e.starts_with("W/"));
        let answer = match self.client.get(&self.url, has, etag) {
            Ok(answer) => answer,
            // After something was fetched the way to the server may come back; before, it is not there.
            Err(http::Failure::NoWay(e)) if has == 0 => return Err(Ended::Final(e)),
            Err(http::Failure::NoWay(e)) => return Err(Ended::Broken(e.to_string())),
            Err(http::Failure::Broken(why)) => return Err(Ended::Broken(why)),
            Err(http::Failure::Final(e)) => return Err(Ended::Final(e)),
        };
        self.compare_before(&answer)?;
        self.revision = answer.revision.clone().or(self.revision.take());
        let other_version = has > 0 && before.sha256.is_some() && before.sha256 != answer.sha256;
        match answer.start {
            Some(start) if start == has && !other_version => {}
            None if answer.status == 416 && !other_version && answer.total == Some(has) => return Ok(()),
            None if answer.status == 200 => has = 0,
            // A part that does not fit, or of another version: all of it is fetched anew.
            _ => {
                forget(&self.path);
                return Err(Ended::Broken(
                    "the server has another version of the file than was begun".into(),
                ));
            }
        }
        let now =
            Progress { url: self.url.clone(), etag: answer.etag.clone(), sha256: answer.sha256.clone() };
        self.body(answer, has, &now, watch)
    }

    /// Whether the server's own hash is the one that is expected: known before 5 GB were fetched in vain.
    fn compare_before(&mut self, answer: &Answer) -> Result<()> {
        let Some(reported) = &answer.sha256 else { return Ok(()) };
        match &self.expected {
            None => {
                self.expected = Some(reported.clone());
                self.compared_with = "server";
                Ok(())
            }
            Some(expected) if expected == reported => Ok(()),
            Some(expected) => {
                let message = format!(
                    "{}: the server has a file with the SHA-256 {reported}, but {expected} ({}) is expected: it was replaced, \
                     or it is another file. Nothing was fetched; if its page confirms it, use --sha256 {reported}",
                    self.url, self.compared_with
                );
                Err(Error::new(ErrorKind::Network, message))
            }
        }
    }

    /// Appends what the server sends to the first `has` bytes.
    fn body(&self, answer: Answer, mut has: u64, now: &Progress, watch: Watch<'_>) -> Result<(), Ended> {
        let failed = |e: io::Error| Ended::Final(durable::cannot_write(&self.path, e));
        let total = answer.total;
        if total.is_some_and(|total| total > self.options.max_bytes) {
            return Err(self.too_large(total));
        }
        self.room(total.map_or(SPARE, |total| total.saturating_sub(has)))?;
        let mut looked = has;
        let text = serde_json::to_vec(now).unwrap_or_default();
        std::fs::write(self.path.with_extension("json"), text).map_err(failed)?;
        let mut file = OpenOptions::new().create(true).append(true).open(&self.path).map_err(failed)?;
        file.set_len(has).map_err(failed)?;
        let mut body = answer.body;
        let mut part = vec![0; 256 << 10];
        let broken = loop {
            if watch("fetch", has, total.unwrap_or(has)).is_break() {
                return Err(Ended::Final(self.ended()));
            }
            let n = match body.read(&mut part) {
                Ok(0) => break None,
                Ok(n) => n,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                Err(e) => break Some(e),
            };
            file.write_all(&part[..n]).map_err(failed)?;
            has += n as u64;
            if total.is_some_and(|total| has > total) {
                break None;
            }
            if has > self.options.max_bytes {
                forget(&self.path);
                return Err(self.too_large(total));
            }
            if total.is_none() && has - looked >= LOOK_EVERY {
                looked = has;
                self.room(SPARE).inspect_err(|_| forget(&self.path))?;
            }
        };
        file.sync_all().map_err(failed)?;
        match (broken, total) {
            (_, Some(total)) if has > total => {
                forget(&self.path);
                Err(Ended::Broken(format!("the server said {total} bytes and sent {has}")))
            }
            (None, Some(total)) if has == total => Ok(()),
            (None, None) => Ok(()),
            (Some(_), Some(total)) if has == total => Ok(()),
            (None, Some(total)) => {
                Err(Ended::Broken(format!("the server ended after {has} of {total} bytes")))
            }
            (Some(e), Some(total)) => {
                Err(Ended::Broken(format!("it broke off after {has} of {total} bytes: {e}")))
            }
            (Some(e), None) => Err(Ended::Broken(format!("it broke off after {has} bytes: {e}"))),
        }
    }

    fn too_large(&self, total: Option<u64>) -> Ended {
        let most = self.options.max_bytes;
        let url = &self.url;
        let what = total.map_or_else(
            || format!("the server sends more than {most} bytes without saying how many there are"),
            |total| format!("the file has {total} bytes, and {most} is the most that is fetched"),
        );
        let message = format!(
            "{url}: {what}; no checkpoint is so large: check the address, or download it by other means and install it with \
             `depthrig cdm import`"
        );
        Ended::Final(Error::new(ErrorKind::Network, message))
    }

    /// Checks that the disk has room for the rest.
    fn room(&self, needed: u64) -> Result<(), Ended> {
        let folder = self.path.parent().unwrap_or(Path::new("."));
        let Ok(disk) = rustix::fs::statvfs(folder) else { return Ok(()) };
        let free = disk.f_bavail * disk.f_frsize;
        if free >= needed {
            return Ok(());
        }
        let text = format!("{needed} bytes more are needed and {free} are free");
        let e = io::Error::new(io::ErrorKind::StorageFull, text);
        Err(Ended::Final(durable::cannot_write(&self.path, e)))
    }

    /// The hash of the whole file, which is the one that is expected, and its size.
    fn proven(&self, watch: Watch<'_>) -> Result<(String, u64)> {
        let failed = |e: io::Error| {
            Error::new(ErrorKind::Io, format!("{}: cannot be read: {e}", self.path.display())).with_source(e)
        };
        let mut file = depthrig_bus::files::open(&self.path).map_err(failed)?;
        let total = file.metadata().map_err(failed)?.len();
        let mut hash = Sha256::new();
        let mut part = vec![0; 1 << 20];
        let mut done = 0;
        loop {
            let n = file.read(&mut part).map_err(failed)?;
            if n == 0 {
                break;
            }
            hash.update(&part[..n]);
            done += n as u64;
            if watch("check", done, total).is_break() {
                return Err(self.ended());
            }
        }
        let has = durable::hex(&hash.finalize());
        match &self.expected {
            Some(expected) if *expected != has => {
                forget(&self.path);
                let message = format!(
                    "{}: what came has the SHA-256 {has}, and {expected} ({}) is expected. It was thrown away; fetch it again, \
                     and if that is no better, look at the page of the file",
                    self.url, self.compared_with
                );
                Err(Error::new(ErrorKind::Network, message))
            }
            _ => Ok((has, done)),
        }
    }

    fn progress(&self) -> Progress {
        let text =
            depthrig_bus::files::read(&self.path.with_extension("json"), depthrig_bus::files::TEXT_MAX_BYTES)
                .unwrap_or_default();
        serde_json::from_slice(&text).unwrap_or_default()
    }
}

/// Bytes of a file; 0 when it is not there.
fn len(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |m| m.len())
}

/// Removes a file and its progress file.
fn forget(path: &Path) {
    for path in [path.to_owned(), path.with_extension("json")] {
        drop(std::fs::remove_file(path)); // it need not be there
    }
}

#[cfg(test)]
mod tests;
