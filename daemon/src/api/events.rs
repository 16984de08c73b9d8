//! Events of a calibration: a process that takes views of a board posts them, and others follow.
//!
//! Nothing is queued: the latest event is kept, and a reader that is slower than they come skips some. Followers have a limit of
//! their own, so that they never take all places of the API.

use super::reply::Refusal;
use axum::body::Body;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use core::convert::Infallible;
use core::future::Future;
use core::pin::Pin;
use core::task::{Context, Poll};
use core::time::Duration;
use depthrig_calibrate::capture::Progress;
use hyper::body::{Bytes, Frame};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

/// Followers at once.
pub const MAX_FOLLOWERS: usize = 16;
/// A follower that nothing new is sent to gets an empty line this often, which shows that the connection lives.
const KEEP_ALIVE: Duration = Duration::from_secs(5);

/// An event of a process that takes views of a board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CaptureEvent {
    /// When, nanoseconds since 1970 UTC.
    pub utc_ns: i64,
    /// The dataset that the views go into.
    pub out: String,
    /// Whether the capture has ended; no event follows.
    pub is_finished: bool,
    /// Why a board that seems to be there was refused, with the camera's name.
    pub refused: Vec<String>,
    /// View of each camera, and missing things.
    pub progress: Progress,
}

/// The latest event and those who follow.
#[derive(Debug, Clone)]
pub(super) struct Events {
    latest: Arc<watch::Sender<Option<Bytes>>>,
    places: Arc<Semaphore>,
    /// True when the service ends.
    stopped: watch::Receiver<bool>,
}

impl Events {
    pub(super) fn new(stopped: watch::Receiver<bool>) -> Self {
        let places = Arc::new(Semaphore::new(MAX_FOLLOWERS));
        Self { latest: Arc::new(watch::Sender::new(None)), places, stopped }
    }

    /// Takes a new event.
    pub(super) fn post(&self, event: &CaptureEvent) -> Result<(), Refusal> {
        let json = serde_json::to_string(event).map_err(|e| {
            Refusal::new(StatusCode::BAD_REQUEST, format!("the event cannot be passed on: {e}"))
        })?;
        self.latest.send_replace(Some(Bytes::from(format!("data: {json}\n\n"))));
        Ok(())
    }

    /// An answer that goes on: the latest event, then each new one, as server-sent events.
    pub(super) fn follow(&self) -> Result<Response, Refusal> {
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| {
            let message = format!("{MAX_FOLLOWERS} readers follow the events already; close one");
            Refusal::new(StatusCode::SERVICE_UNAVAILABLE, message)
        })?;
        let mut latest = self.latest.subscribe();
        // Those who join late begin with what is known.
        latest.mark_changed();
        let follower = Follower { latest, stopped: self.stopped.clone(), _place: place };
        let mut response = Body::new(Stream { next: Box::pin(follower.next()) }).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("text/event-stream"));
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        Ok(response)
    }
}

struct Follower {
    latest: watch::Receiver<Option<Bytes>>,
    stopped: watch::Receiver<bool>,
    _place: OwnedSemaphorePermit,
}

struct Next {
    bytes: Bytes,
    follower: Follower,
}

impl Follower {
    /// The next bytes to send; `None` at the end of the service.
    async fn next(mut self) -> Option<Next> {
        loop {
            let wake = tokio::select! {
                // An error means that the service is gone.
                _ = self.stopped.wait_for(|stopped| *stopped) => Wake::End,
                changed = self.latest.changed() => if changed.is_ok() { Wake::Event } else { Wake::End },
                () = tokio::time::sleep(KEEP_ALIVE) => Wake::Silence,
            };
            let bytes = match wake {
                Wake::End => return None,
                Wake::Event => self.latest.borrow_and_update().clone(),
                Wake::Silence => Some(Bytes::from_static(b":\n\n")),
            };
            if let Some(bytes) = bytes {
                return Some(Next { bytes, follower: self });
            }
        }
    }
}

/// Why a follower woke up.
enum Wake {
    End,
    Event,
    Silence,
}

/// The body of an answer that goes on.
struct Stream {
    next: Pin<Box<dyn Future<Output = Option<Next>> + Send>>,
}

impl hyper::body::Body for Stream {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let Poll::Ready(next) = self.next.as_mut().poll(cx) else { return Poll::Pending };
        let Some(Next { bytes, follower }) = next else {
            // Polled again, it ends again.
            self.next = Box::pin(async { None });
            return Poll::Ready(None);
        };
        self.next = Box::pin(follower.next());
        Poll::Ready(Some(Ok(Frame::data(bytes))))
    }
}
