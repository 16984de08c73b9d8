//! Requests of `object_store` by the HTTP client that downloads models: TLS, certificates and timeouts are the same, and
//! no second client is built.

use bytes::Bytes;
use depthrig_cdm::fetch::agent;
use http_body_util::BodyExt as _;
use object_store::ClientOptions;
use object_store::client::{
    HttpClient, HttpConnector, HttpError, HttpErrorKind, HttpRequest, HttpResponse, HttpService,
};
use ureq::Agent;
use ureq::http::{Method, Request, request};

/// The largest answer that is read, bytes: objects are read in parts, lists in pages of 1000.
const ANSWER_MAX: u64 = 64 << 20;

/// Makes clients for the server at this address.
#[derive(Debug)]
pub(super) struct Connector {
    pub(super) url: String,
}

impl HttpConnector for Connector {
    fn connect(&self, _: &ClientOptions) -> object_store::Result<HttpClient> {
        Ok(HttpClient::new(Client { agent: agent(&self.url) }))
    }
}

#[derive(Debug)]
struct Client {
    agent: Agent,
}

#[async_trait::async_trait]
impl HttpService for Client {
    async fn call(&self, request: HttpRequest) -> Result<HttpResponse, HttpError> {
        let (parts, body) = request.into_parts();
        let body = body.collect().await?.to_bytes();
        let agent = self.agent.clone();
        let sent = tokio::task::spawn_blocking(move || send(&agent, parts, &body));
        sent.await.map_err(|e| HttpError::new(HttpErrorKind::Unknown, e))?.map_err(failure)
    }
}

/// Sends a request and reads the answer to its end: one that breaks off in the middle is asked for again as a whole.
fn send(agent: &Agent, parts: request::Parts, body: &Bytes) -> Result<HttpResponse, ureq::Error> {
    let answer = if [Method::PUT, Method::POST].contains(&parts.method) {
        agent.run(Request::from_parts(parts, body.as_ref()))?
    } else {
        agent.run(Request::from_parts(parts, ()))?
    };
    let (parts, mut body) = answer.into_parts();
    let bytes = body.with_config().limit(ANSWER_MAX).read_to_vec()?;
    Ok(HttpResponse::from_parts(parts, bytes.into()))
}

/// Which failures `object_store` tries again: whenever no answer came. Nothing that is asked here does harm when it is done
/// twice, since objects are put unless they are there, or with the bytes that they have.
fn failure(e: ureq::Error) -> HttpError {
    use std::io::ErrorKind::{
        BrokenPipe, ConnectionAborted, ConnectionRefused, ConnectionReset, TimedOut, UnexpectedEof,
    };
    let is_lost = match &e {
        // Protocol: an answer that ends before its head is complete.
        ureq::Error::HostNotFound
        | ureq::Error::ConnectionFailed
        | ureq::Error::Timeout(_)
        | ureq::Error::Protocol(_) => true,
        ureq::Error::Io(io) => matches!(
            io.kind(),
            BrokenPipe | ConnectionAborted | ConnectionRefused | ConnectionReset | TimedOut | UnexpectedEof
        ),
        _ => false,
    };
    HttpError::new(if is_lost { HttpErrorKind::Request } else { HttpErrorKind::Unknown }, e)
}
