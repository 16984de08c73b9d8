//! The token that requests over TCP must carry: other users of this computer reach the port, and only the user that runs
//! the rig can read the token's file.

use super::page::{self, LIVE, REPORT};
use super::reply::Refusal;
use crate::{Error, ErrorKind, Result};
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Random bytes of a token.
const BYTES: usize = 32;
/// Served without a token: numbers for Prometheus, which runs as a user of its own. So are the files of the live page, which have no secret, and its WebSocket,
/// whose first message has the token.
const OPEN_PATH: &str = "/metrics";

/// A token with its file, which goes with it.
pub(super) struct Token {
    text: String,
    path: PathBuf,
}

/// Without the secret.
impl core::fmt::Debug for Token {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Token").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Token {
    /// A new token in the file `path`, which only this user can read; one of an earlier daemon is replaced.
    pub(super) fn create(path: PathBuf) -> Result<Arc<Self>> {
        let text = write_new(&path).map_err(|e| {
            let kind = match e.kind() {
                io::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
                io::ErrorKind::StorageFull => ErrorKind::NoSpace,
                _ => ErrorKind::Other,
            };
            Error::new(kind, format!("API token {} cannot be written: {e}", path.display())).with_source(e)
        })?;
        Ok(Arc::new(Self { text, path }))
    }

    /// Its file.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Compares without ending at the first difference, so that the time taken says nothing about the token.
    pub(super) fn is(&self, given: &str) -> bool {
        let ours = self.text.as_bytes();
        let theirs = given.as_bytes();
        let differ = ours.iter().zip(theirs).fold(0, |sum, (a, b)| sum | (a ^ b));
        std::hint::black_box(differ) == 0 && ours.len() == theirs.len()
    }

    fn allows(&self, request: &Request) -> bool {
        let mut headers = request.headers().get_all(header::AUTHORIZATION).iter();
        let given = headers.next().and_then(|v| v.to_str().ok()).and_then(|v| v.split_once(' '));
        given.is_some_and(|(scheme, token)| scheme.eq_ignore_ascii_case("bearer") && self.is(token.trim()))
            && headers.next().is_none()
    }
}

impl Drop for Token {
    fn drop(&mut self) {
        // A daemon that took over may have replaced it.
        if std::fs::read_to_string(&self.path).is_ok_and(|text| text.trim_end() == self.text) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// A text that nobody can guess.
pub(super) fn random_text() -> io::Result<String> {
    let mut random = [0; BYTES];
    File::open("/dev/urandom")?.read_exact(&mut random)?;
    Ok(random.iter().fold(String::new(), |text, b| text + &format!("{b:02x}")))
}

fn write_new(path: &Path) -> io::Result<String> {
    let text = random_text()?;
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    file.write_all(text.as_bytes())?;
    file.write_all(b"\n")?;
    Ok(text)
}

/// Refuses requests of a port without the token.
pub(super) async fn bearer(State(token): State<Arc<Token>>, request: Request, next: Next) -> Response {
    let path = request.uri().path();
    // The address of a report is a secret of its own.
    let is_open = path == OPEN_PATH || path == LIVE || path.starts_with(REPORT) || page::is_page(path);
    if is_open || token.allows(&request) {
        return next.run(request).await;
    }
    let message = format!(
        "over TCP a request needs the header \"Authorization: Bearer TOKEN\"; the token is in {}, which the user that \
         runs the rig can read",
        token.path().display()
    );
    let mut response = Refusal::denied(StatusCode::UNAUTHORIZED, message).into_response();
    response.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    response
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_token_is_private_new_each_time_and_goes_with_its_daemon() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.token");
        let first = Token::create(path.clone()).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        let second = Token::create(path.clone()).unwrap();
        assert_ne!(first.text, second.text);
        assert_eq!(second.text.len(), 2 * BYTES);
        drop(first);
        assert_eq!(
            std::fs::read_to_string(&path).unwrap().trim_end(),
            second.text,
            "it is not the first one's"
        );
        drop(second);
        assert!(!path.exists());
    }

    #[test]
    fn only_the_whole_token_is_the_token() {
        let folder = tempfile::tempdir().unwrap();
        let token = Token::create(folder.path().join("rig.token")).unwrap();
        let text = token.text.clone();
        let longer = format!("{text}0");
        let shorter = &text[..text.len() - 1];
        let flipped: String = text.chars().map(|c| if c == '0' { '1' } else { '0' }).collect();
        assert!(token.is(&text));
        for wrong in
            ["", shorter, &longer, &flipped, &text.to_uppercase().replace(|c: char| c.is_numeric(), "x")]
        {
            assert!(!token.is(wrong), "{wrong}");
        }
    }
}
