//! One HTTP request over a Unix socket, blocking.

use crate::{Error, ErrorKind, Result};
use core::fmt;
use core::time::Duration;
use http_body_util::{BodyExt, Full, Limited};
use hyper::body::Bytes;
use hyper_util::rt::TokioIo;
use std::io;
use std::path::{Path, PathBuf};
use tokio::net::UnixStream;

/// The largest answer that is read, bytes; a status of 64 cameras is a tenth of it.
const MAX_ANSWER_BYTES: usize = 4 << 20;

/// Connects to one socket. Each request is a connection of its own.
#[derive(Debug)]
pub(super) struct Connector {
    path: PathBuf,
    runtime: tokio::runtime::Runtime,
}

/// The answer of the daemon.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) status: u16,
    /// The `server` header.
    pub(super) server: String,
    pub(super) body: Vec<u8>,
}

/// Why nothing came back.
#[derive(Debug)]
pub(super) enum Failure {
    /// The socket does not exist.
    Absent(io::Error),
    /// There is a socket and nobody behind it.
    Refused(io::Error),
    /// This user may not.
    Denied(io::Error),
    /// No answer within this time.
    Silent(Duration),
    /// The conversation broke off.
    Broken(Box<dyn std::error::Error + Send + Sync>),
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Absent(e) | Self::Refused(e) | Self::Denied(e) => e.fmt(f),
            Self::Silent(timeout) => write!(f, "no answer within {} s", timeout.as_secs()),
            Self::Broken(e) => e.fmt(f),
        }
    }
}

impl std::error::Error for Failure {}

impl Connector {
    pub(super) fn new(path: PathBuf) -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(|e| {
            Error::new(ErrorKind::Other, format!("the client cannot be started: {e}")).with_source(e)
        })?;
        Ok(Self { path, runtime })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Sends a request, JSON if it has a body, and reads the whole answer.
    pub(super) fn send(
        &self,
        method: &str,
        path: &str,
        body: Option<Vec<u8>>,
        timeout: Duration,
    ) -> Result<Answer, Failure> {
        self.runtime.block_on(async {
            let exchange = tokio::time::timeout(timeout, self.exchange(method, path, body)).await;
            exchange.unwrap_or(Err(Failure::Silent(timeout)))
        })
    }

    async fn exchange(&self, method: &str, path: &str, body: Option<Vec<u8>>) -> Result<Answer, Failure> {
        let stream = UnixStream::connect(&self.path).await.map_err(|e| match e.kind() {
            io::ErrorKind::NotFound => Failure::Absent(e),
            io::ErrorKind::ConnectionRefused => Failure::Refused(e),
            io::ErrorKind::PermissionDenied => Failure::Denied(e),
            _ => Failure::Broken(e.into()),
        })?;
        let (mut sender, connection) =
            hyper::client::conn::http1::handshake(TokioIo::new(stream)).await.map_err(broken)?;
        let mut request = hyper::Request::builder().method(method).uri(path).header("host", "localhost");
        if body.is_some() {
            request = request.header("content-type", "application/json");
        }
        let request = request.body(Full::new(Bytes::from(body.unwrap_or_default()))).map_err(broken)?;
        let exchange = async {
            let response = sender.send_request(request).await.map_err(broken)?;
            let status = response.status().as_u16();
            let server = response.headers().get(crate::api::SERVER_HEADER);
            let server = server.and_then(|v| v.to_str().ok()).unwrap_or_default().to_owned();
            let body = Limited::new(response.into_body(), MAX_ANSWER_BYTES)
                .collect()
                .await
                .map_err(Failure::Broken)?;
            Ok(Answer { status, server, body: body.to_bytes().to_vec() })
        };
        // The connection only moves while it is polled. That it ends first is no error as long as the answer is in.
        tokio::pin!(exchange);
        tokio::select! {
            answer = &mut exchange => answer,
            ended = connection => match (exchange.await, ended) {
                (Err(_), Err(e)) => Err(broken(e)),
                (answer, _) => answer,
            },
        }
    }
}

fn broken(e: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Broken(Box::new(e))
}
