//! The call that turns a connection of the socket into one for the live frames of a stream ([`crate::mirror`]).

use super::limits::Limited;
use super::live::Live;
use super::reply::Refusal;
use crate::control::Control;
use crate::mirror::{Answering, PROTOCOL, answer};
use axum::Extension;
use axum::body::Body;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::Response;
use depthrig_bus::{RigName, RuntimeDir, StreamId};
use hyper::upgrade::{OnUpgrade, Upgraded};
use hyper_util::rt::TokioIo;
use std::io;
use std::os::unix::net;
use std::sync::Arc;
use tokio::net::UnixStream;

/// The bus whose streams are asked for.
#[derive(Debug, Clone)]
pub(super) struct Served {
    pub(super) runtime: RuntimeDir,
    pub(super) rig: RigName,
}

/// Answers questions for frames of the stream from now on, on a thread of its own.
pub(super) async fn upgrade(
    State(control): State<Arc<dyn Control>>,
    Extension(live): Extension<Live>,
    Extension(served): Extension<Served>,
    Path((camera, stream)): Path<(String, String)>,
    mut request: Request,
) -> Result<Response, Refusal> {
    let bad = |what: String| Refusal::new(StatusCode::BAD_REQUEST, what);
    let id = StreamId::new(&camera, &stream).map_err(|e| bad(e.to_string()))?;
    if live.token.is_some() {
        return Err(Refusal::denied(StatusCode::FORBIDDEN, "frames are sent over the Unix socket alone"));
    }
    let asked = request.headers().get(header::UPGRADE).is_some_and(|v| v.as_bytes() == PROTOCOL.as_bytes());
    let Some(on_upgrade) = request.extensions_mut().remove::<OnUpgrade>().filter(|_| asked) else {
        return Err(bad(format!(
            "the request must have the headers connection: upgrade and upgrade: {PROTOCOL}"
        )));
    };
    let place = Arc::clone(&live.places).try_acquire_owned().map_err(|_| {
        Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "too many viewers and streams are connected; close one")
    })?;
    tokio::spawn(async move {
        let peer = match on_upgrade.await.map_err(io::Error::other).and_then(blocking) {
            Ok(peer) => peer,
            Err(e) => return tracing::warn!("frames of {id} cannot be sent: {e}"),
        };
        let run = move || {
            let to = Answering { peer, runtime: served.runtime, rig: served.rig, id: id.clone() };
            let ended = answer(to, &|at| control.session_clock(at), &|| *live.stopped.borrow());
            if let Err(e) = ended {
                tracing::info!("frames of {id} are not sent any more: {e}");
            }
            drop(place);
        };
        if let Err(e) = std::thread::Builder::new().name("mirror".to_owned()).spawn(run) {
            tracing::warn!("no thread sends frames: {e}");
        }
    });
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    let headers = response.headers_mut();
    headers.insert(header::CONNECTION, HeaderValue::from_static("upgrade"));
    headers.insert(header::UPGRADE, HeaderValue::from_static(PROTOCOL));
    Ok(response)
}

/// The socket below a connection that HTTP has left.
fn blocking(upgraded: Upgraded) -> io::Result<net::UnixStream> {
    let other = |_| io::Error::other("it is not a Unix socket");
    let parts = upgraded.downcast::<TokioIo<Limited<UnixStream>>>().map_err(other)?;
    if !parts.read_buf.is_empty() {
        return Err(io::Error::new(io::ErrorKind::InvalidData, "the peer asked before it was answered"));
    }
    let socket = parts.io.into_inner().into_inner().into_std()?;
    socket.set_nonblocking(false)?;
    Ok(socket)
}
