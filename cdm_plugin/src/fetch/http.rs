//! One request for a part of a file, through redirects, with the servers' metadata of the file.

use crate::{Error, ErrorKind};
use core::time::Duration;
use std::io::Read;
use std::sync::Arc;
use ureq::http::{HeaderMap, Response};
use ureq::tls::{RootCerts, TlsConfig, TlsProvider};
use ureq::{Agent, Body};

const REDIRECTS: u32 = 10;

/// An HTTP client for the server at `url`, with the computer's own root certificates and the proxies of its environment. It
/// follows no redirect and takes no status for an error.
pub fn agent(url: &str) -> Agent {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let tls = TlsConfig::builder()
        .provider(TlsProvider::Rustls)
        .root_certs(RootCerts::PlatformVerifier)
        .unversioned_rustls_crypto_provider(provider)
        .build();
    let config = Agent::config_builder()
        .tls_config(tls)
        .http_status_as_error(false)
        // Followed by the caller: each answer is looked at, and what proves who asks goes to the first server alone.
        .max_redirects(0)
        .max_redirects_will_error(false)
        .timeout_connect(Some(Duration::from_secs(30)))
        .timeout_recv_response(Some(Duration::from_mins(1)))
        .timeout_per_read(Some(Duration::from_mins(1)))
        .timeout_per_write(Some(Duration::from_mins(1)))
        .user_agent(concat!("depthrig/", env!("CARGO_PKG_VERSION")));
    // This computer is never behind a proxy.
    let here = ["127.0.0.1", "localhost", "[::1]"].contains(&host(url));
    let config = if here { config.proxy(None) } else { config };
    config.build().new_agent()
}

/// Asks servers.
pub(super) struct Client {
    agent: Agent,
    token: Option<String>,
}

/// Answer of a server.
pub(super) struct Answer {
    pub status: u16,
    /// The place in the file where the body begins, when it is a part of it.
    pub start: Option<u64>,
    /// Bytes of the whole file.
    pub total: Option<u64>,
    pub etag: Option<String>,
    /// The hash that the server reported, in hexadecimal.
    pub sha256: Option<String>,
    /// The version of the repository.
    pub revision: Option<String>,
    pub body: Box<dyn Read>,
}

/// Failure to get a usable answer.
pub(super) enum Failure {
    /// The server could not be reached.
    NoWay(Error),
    /// It may be better the next time.
    Broken(String),
    /// It will be the same the next time.
    Final(Error),
}

impl Client {
    /// For files at `url`.
    pub(super) fn new(token: Option<String>, url: &str) -> Self {
        Self { agent: agent(url), token }
    }

    /// Asks for the file from byte `from` on; when its mark is still `etag`, if there is one.
    pub(super) fn get(&self, url: &str, from: u64, etag: Option<&str>) -> Result<Answer, Failure> {
        let mut reported = Reported::default();
        let mut at = url.to_owned();
        for _ in 0..REDIRECTS {
            let mut request = self.agent.get(&at).header("Accept-Encoding", "identity");
            if let Some(token) = self.token.as_ref().filter(|_| origin(&at) == origin(url)) {
                request = request.header("Authorization", format!("Bearer {token}"));
            }
            if from > 0 {
                request = request.header("Range", format!("bytes={from}-"));
                // The mark is that of the server which sends the file, and means nothing to those that point to it.
                if let Some(etag) = etag {
                    request = request.header("If-Range", etag);
                }
            }
            let response = request.call().map_err(|e| failure(&at, e))?;
            reported.learn(response.headers());
            match response.status().as_u16() {
                301 | 302 | 303 | 307 | 308 => at = next(&at, response.headers())?,
                _ => return reported.answer(&at, response, self.token.is_some()),
            }
        }
        let message = format!("{url}: the server points from place to place without end");
        Err(Failure::Final(Error::new(ErrorKind::Network, message)))
    }
}

/// Metadata from the headers of all redirects.
#[derive(Default)]
struct Reported {
    size: Option<u64>,
    sha256: Option<String>,
    revision: Option<String>,
}

impl Reported {
    fn learn(&mut self, headers: &HeaderMap) {
        self.size = self.size.or_else(|| text(headers, "x-linked-size")?.parse().ok());
        if self.sha256.is_none() {
            let etag = text(headers, "x-linked-etag")
                .map(|e| e.trim_start_matches("W/").trim_matches('"').to_owned());
            let is_hash = |e: &String| e.len() == 64 && e.bytes().all(|b| b.is_ascii_hexdigit());
            self.sha256 = etag.filter(is_hash).map(|e| e.to_ascii_lowercase());
        }
        if self.revision.is_none() {
            self.revision = text(headers, "x-repo-commit").map(str::to_owned);
        }
    }

    fn answer(self, url: &str, response: Response<Body>, with_token: bool) -> Result<Answer, Failure> {
        let status = response.status().as_u16();
        let headers = response.headers();
        let range = text(headers, "content-range").and_then(content_range);
        let kind = text(headers, "content-type").unwrap_or_default();
        let length = text(headers, "content-length").and_then(|l| l.parse::<u64>().ok());
        let fail = |what: String| Failure::Final(Error::new(ErrorKind::Network, format!("{url}: {what}")));
        let (start, total) = match status {
            200 if kind.starts_with("text/html") => {
                return Err(fail(
                    "the answer is a page, not a file; is there a login of the network in between?".into(),
                ));
            }
            200 => (None, length),
            206 => match range {
                Some((Some(start), total)) => (Some(start), total),
                _ => return Err(fail("the server sends a part of the file and does not say which".into())),
            },
            416 => (None, range.and_then(|(_, total)| total)),
            401 | 403 => {
                let cure = if with_token {
                    "the token (HF_TOKEN) does not open it: accept the terms on the page of the model with that account"
                } else {
                    "it may want an account: accept the terms on the page of the model, make a token there, and set HF_TOKEN \
                     to it; or download the file in a browser and install it with `depthrig cdm import`"
                };
                return Err(fail(format!("the server does not give the file out (status {status}); {cure}")));
            }
            404 | 410 => {
                return Err(fail(format!(
                    "there is no such file (status {status}); it may have been moved: look for it at \
                     https://huggingface.co/depth-anything and say --url, or download it and use `depthrig cdm import`"
                )));
            }
            407 => return Err(fail("the proxy wants a name and a password: set them in HTTPS_PROXY".into())),
            408 | 425 | 429 | 500..=599 => {
                return Err(Failure::Broken(format!("the server has no answer now (status {status})")));
            }
            other => return Err(fail(format!("the server answers with status {other}"))),
        };
        // The size of the final server counts only if no earlier one reported a size.
        let total = self.size.or(total);
        let etag = text(headers, "etag").map(str::to_owned);
        let body = Box::new(response.into_body().into_reader());
        Ok(Answer { status, start, total, etag, sha256: self.sha256, revision: self.revision, body })
    }
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name)?.to_str().ok().map(str::trim)
}

/// `bytes 5-9/10`: where the part begins, and how long the whole is. `bytes */10`: the whole alone.
fn content_range(text: &str) -> Option<(Option<u64>, Option<u64>)> {
    let (range, total) = text.strip_prefix("bytes ")?.split_once('/')?;
    let start = range.split_once('-').and_then(|(start, _)| start.trim().parse().ok());
    Some((start, total.trim().parse().ok()))
}

/// `https://host:port` of an address.
fn origin(url: &str) -> &str {
    let from = url.find("://").map_or(0, |at| at + 3);
    let end = url[from..].find(['/', '?', '#']).map_or(url.len(), |at| from + at);
    &url[..end]
}

fn host(url: &str) -> &str {
    let origin = origin(url);
    let authority = origin.split_once("://").map_or(origin, |(_, a)| a);
    match authority.rsplit_once(':') {
        Some((host, port)) if port.bytes().all(|b| b.is_ascii_digit()) => host,
        _ => authority,
    }
}

/// Where a redirect points to.
fn next(from: &str, headers: &HeaderMap) -> Result<String, Failure> {
    let fail = |what: &str| Failure::Final(Error::new(ErrorKind::Network, format!("{from}: {what}")));
    let to = text(headers, "location")
        .ok_or_else(|| fail("the server points elsewhere and does not say where"))?;
    let to = if to.starts_with("http://") || to.starts_with("https://") {
        to.to_owned()
    } else if let Some(rest) = to.strip_prefix("//") {
        format!("{}//{rest}", origin(from).split("//").next().unwrap_or("https:"))
    } else if to.starts_with('/') {
        format!("{}{to}", origin(from))
    } else {
        return Err(fail(&format!("the server redirects to the invalid address {to:?}")));
    };
    if from.starts_with("https://") && !to.starts_with("https://") {
        return Err(fail("the server points to a place without encryption; it is not followed"));
    }
    Ok(to)
}

/// Why a request was not answered.
fn failure(url: &str, e: ureq::Error) -> Failure {
    let offline =
        "; without a network, download the file elsewhere and install it with `depthrig cdm import FILE`";
    let no_way =
        |what: String| Failure::NoWay(Error::new(ErrorKind::Network, format!("{url}: {what}{offline}")));
    match e {
        ureq::Error::HostNotFound => {
            no_way(format!("the server {} is not found: is there a network?", host(url)))
        }
        ureq::Error::ConnectionFailed => no_way(format!("{} cannot be reached", host(url))),
        ureq::Error::Timeout(ureq::Timeout::Connect | ureq::Timeout::Resolve) => {
            no_way(format!("{} does not answer", host(url)))
        }
        ureq::Error::Io(e)
            if matches!(
                e.kind(),
                std::io::ErrorKind::ConnectionRefused
                    | std::io::ErrorKind::HostUnreachable
                    | std::io::ErrorKind::NetworkUnreachable
                    | std::io::ErrorKind::AddrNotAvailable
            ) =>
        {
            no_way(format!("{} cannot be reached: {e}", host(url)))
        }
        ureq::Error::ConnectProxyFailed(e) => no_way(format!("the proxy does not let it through: {e}")),
        ureq::Error::InvalidProxyUrl => no_way("invalid proxy address in HTTPS_PROXY".into()),
        ureq::Error::Rustls(e) => {
            let message = format!(
                "{url}: {} does not prove who it is: {e}; a proxy of the network may stand in between (its certificate must be \
                 among those of this computer), or this computer's date is wrong",
                host(url)
            );
            Failure::Final(Error::new(ErrorKind::Network, message).with_source(e))
        }
        ureq::Error::BadUri(e) => {
            Failure::Final(Error::new(ErrorKind::BadInput, format!("{url}: not an address of the web: {e}")))
        }
        e => Failure::Broken(format!("the server did not answer: {e}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_taken_apart() {
        for (url, origin_, host_) in [
            ("https://huggingface.co/a/b?c", "https://huggingface.co", "huggingface.co"),
            ("http://127.0.0.1:8080", "http://127.0.0.1:8080", "127.0.0.1"),
            ("http://[::1]:80/x", "http://[::1]:80", "[::1]"),
            ("https://host?x", "https://host", "host"),
        ] {
            assert_eq!((origin(url), host(url)), (origin_, host_), "{url}");
        }
        assert_eq!(content_range("bytes 5-9/10"), Some((Some(5), Some(10))));
        assert_eq!(content_range("bytes */10"), Some((None, Some(10))));
        assert_eq!(content_range("bytes 5-9/*"), Some((Some(5), None)));
        assert_eq!(content_range("lines 5-9/10"), None);
    }

    #[test]
    fn a_redirect_stays_encrypted() {
        let to = |from: &str, location: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("location", location.parse().unwrap());
            next(from, &headers).ok()
        };
        assert_eq!(to("https://a/b", "/c").as_deref(), Some("https://a/c"));
        assert_eq!(to("https://a/b", "//d/c").as_deref(), Some("https://d/c"));
        assert_eq!(to("https://a/b", "https://d/c").as_deref(), Some("https://d/c"));
        assert_eq!(to("http://a/b", "http://d/c").as_deref(), Some("http://d/c"));
        assert_eq!((to("https://a/b", "http://d/c"), to("https://a/b", "c")), (None, None));
    }
}
