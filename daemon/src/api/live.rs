//! The WebSocket of the live page: status, images, signals, and questions about pixels. docs/live-page.md describes its messages.

use super::limits::{close, end_of};
use super::recordings;
use super::reply::Refusal;
use super::requests::{LoopRequest, RateRequest, StepRequest};
use super::token::Token;
use crate::control::{Control, ReplayControl, SeekRequest, Shown};
use crate::status::{ReplayStatus, RigStatus};
use crate::viewers::{
    Geometry, Measured, Message, News, OfStream, PROTOCOL, PixelAnswer, PixelQuestion, Place, ShownSignal,
    SignalFeed, SignalPlace, Viewers, Watch,
};
use axum::Extension;
use axum::extract::ws::{Message as Frame, WebSocket, WebSocketUpgrade};
use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use core::time::Duration;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::time::{Instant, MissedTickBehavior, interval};

/// Time for the first message, which has the token.
const TOKEN_TIMEOUT: Duration = Duration::from_secs(5);
/// Between two messages with the status.
const STATUS_PERIOD: Duration = Duration::from_millis(500);
/// The longest message of a client, bytes: 64 streams with their names.
const MAX_MESSAGE_BYTES: usize = 16 << 10;
/// A client that sends nothing for so long, not even an answer to a ping, has gone.
const SILENCE: Duration = Duration::from_secs(20);
const PING_PERIOD: Duration = Duration::from_secs(5);

/// Bytes that a closing frame holds beside its code (RFC 6455).
const MAX_REASON_BYTES: usize = 123;

/// Reasons for which the server closes; 4000 and more are an application's own (RFC 6455).
mod code {
    pub(super) const STOPPED: u16 = 1001;
    pub(super) const BAD_MESSAGE: u16 = 4400;
    pub(super) const DENIED: u16 = 4401;
    pub(super) const NO_TOKEN: u16 = 4408;
    pub(super) const NOT_SHOWN: u16 = 4404;
    pub(super) const FULL: u16 = 4429;
}

/// The surroundings of a connection of the live page.
#[derive(Clone)]
pub(super) struct Live {
    /// Those who look at the rig.
    pub(super) viewers: Viewers,
    /// The signals of the live rig, whatever a page shows.
    pub(super) signals: SignalFeed,
    /// True when the service ends.
    pub(super) stopped: watch::Receiver<bool>,
    /// One for each connection: what has been upgraded has left the places of the API.
    pub(super) places: Arc<Semaphore>,
    /// The token that the client has to know; `None` on the socket, which only the user that runs the rig can open.
    pub(super) token: Option<Arc<Token>>,
}

/// A message of the client.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Request {
    Token(String),
    Watch(Vec<Watch>),
    Credit(u32),
    Pixel(PixelQuestion),
    /// `null`: none is shown any more.
    Signals(Option<Vec<ShownSignal>>),
    Replay(Steer),
}

/// A command to the replay; the fields are those of the calls below `/v1/replay`.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Steer {
    Pause {},
    Resume {},
    Seek(SeekRequest),
    Step(StepRequest),
    Rate(RateRequest),
    Loop(LoopRequest),
}

impl Steer {
    fn apply(&self, replay: &dyn ReplayControl) -> crate::Result<ReplayStatus> {
        match self {
            Self::Pause {} => replay.pause(),
            Self::Resume {} => replay.resume(),
            Self::Seek(to) => replay.seek(to),
            Self::Step(step) => replay.step(step.sets),
            Self::Rate(request) => replay.set_rate(request.rate),
            Self::Loop(request) => replay.set_loop(request.on),
        }
    }
}

/// Options in a page's address.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Asked {
    /// A recording to show in place of the cameras, as the list of recordings names it.
    dataset: Option<String>,
}

/// A text message to the client.
#[derive(Debug, Serialize)]
#[serde(rename_all = "snake_case")]
enum Answer<'a> {
    Hello(Hello<'a>),
    Status(&'a RigStatus),
    Geometry(&'a OfStream<Geometry>),
    Measure(&'a OfStream<Measured>),
    Pixel(PixelAnswer),
    Signals(News),
    Problem { message: String },
}

#[derive(Debug, Serialize)]
struct Hello<'a> {
    protocol: u16,
    version: &'static str,
    rig: &'a str,
    is_replay: bool,
    /// The recording that is shown in place of the cameras.
    #[serde(skip_serializing_if = "Option::is_none")]
    dataset: Option<&'a str>,
}

/// Why a connection ends.
struct End {
    code: u16,
    reason: String,
}

impl End {
    fn new(code: u16, reason: impl Into<String>) -> Self {
        Self { code, reason: reason.into() }
    }
}

/// Takes the connection over.
pub(super) async fn upgrade(
    upgrade: Result<WebSocketUpgrade, axum::extract::ws::rejection::WebSocketUpgradeRejection>,
    State(rig): State<Arc<dyn Control>>,
    Extension(live): Extension<Live>,
    Query(asked): Query<Asked>,
) -> Response {
    let Ok(held) = Arc::clone(&live.places).try_acquire_owned() else {
        return Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "too many pages are open; close one")
            .into_response();
    };
    match upgrade {
        Ok(upgrade) => upgrade.max_message_size(MAX_MESSAGE_BYTES).on_upgrade(async move |socket| {
            serve(socket, rig, live, asked).await;
            drop(held);
        }),
        Err(_) => Refusal::new(StatusCode::BAD_REQUEST, "this is a WebSocket; the live page (/) opens it")
            .into_response(),
    }
}

async fn serve(mut socket: WebSocket, rig: Arc<dyn Control>, live: Live, asked: Asked) {
    let end = match begin(&mut socket, rig, &live, asked).await {
        Ok(client) => client.serve(&mut socket, live.stopped).await,
        Err(end) => Some(end),
    };
    if let Some(End { code, mut reason }) = end {
        if reason.len() > MAX_REASON_BYTES {
            reason.truncate(reason.floor_char_boundary(MAX_REASON_BYTES - '…'.len_utf8()));
            reason.push('…');
        }
        close(&mut socket, code, &reason).await;
    }
}

/// Checks the token and finds a place.
async fn begin(
    socket: &mut WebSocket,
    rig: Arc<dyn Control>,
    live: &Live,
    asked: Asked,
) -> Result<Client, End> {
    if let Some(token) = &live.token {
        let first = tokio::time::timeout(TOKEN_TIMEOUT, socket.recv()).await;
        match first {
            Err(_) => return Err(End::new(code::NO_TOKEN, "no token came")),
            Ok(Some(Ok(Frame::Text(text)))) => match serde_json::from_str(&text) {
                Ok(Request::Token(given)) if token.is(&given) => {}
                _ => return Err(End::new(code::DENIED, "the token is wrong")),
            },
            Ok(_) => return Err(End::new(code::DENIED, "the token is missing")),
        }
    }
    let mut view = View { rig, viewers: live.viewers.clone(), shown: None };
    if let Some(name) = asked.dataset.clone() {
        let rig = Arc::clone(&view.rig);
        let shown = tokio::task::spawn_blocking(move || show(&*rig, &name)).await;
        view = shown
            .map_err(|e| End::new(code::NOT_SHOWN, e.to_string()))?
            .map_err(|e| End::new(code::NOT_SHOWN, e.to_string()))?;
    }
    let Some((place, messages)) = view.viewers.enter() else {
        return Err(End::new(code::FULL, format!("{} pages are open already", crate::viewers::MAX_VIEWERS)));
    };
    let hello = Hello {
        protocol: PROTOCOL,
        version: env!("CARGO_PKG_VERSION"),
        rig: live.viewers.rig().as_str(),
        is_replay: view.rig.replay().is_some(),
        dataset: asked.dataset.as_deref(),
    };
    send(socket, &Answer::Hello(hello)).await.map_err(|_| End::new(code::STOPPED, ""))?;
    let signals = Some(Arc::new(live.signals.enter()));
    Ok(Client { place, signals, messages, view })
}

/// The source of a page's images: the rig, or one of its recordings.
struct View {
    rig: Arc<dyn Control>,
    viewers: Viewers,
    shown: Option<Arc<Shown>>,
}

fn show(rig: &dyn Control, name: &str) -> crate::Result<View> {
    let nothing = || {
        let what = "this rig shows no recordings; replay one with: depthrig replay DATASET";
        crate::Error::new(crate::ErrorKind::WrongState, what)
    };
    let shows = rig.shows().ok_or_else(nothing)?;
    let shown = shows.show(&recordings::folder(rig, name)?)?;
    let viewers = Viewers::new(shown.runtime.clone(), shown.rig.clone());
    Ok(View { rig: Arc::clone(&shown.control), viewers, shown: Some(shown) })
}

impl Drop for View {
    fn drop(&mut self) {
        if let Some(shown) = self.shown.take() {
            // The end of a replay waits for its threads.
            drop(tokio::task::spawn_blocking(move || drop(shown)));
        }
    }
}

/// A client that may look.
struct Client {
    place: Place,
    /// `None` only while it is dropped.
    signals: Option<Arc<SignalPlace>>,
    messages: mpsc::Receiver<Message>,
    view: View,
}

impl Client {
    /// Serves until one side ends; `None` when the client has gone.
    async fn serve(mut self, socket: &mut WebSocket, mut stopped: watch::Receiver<bool>) -> Option<End> {
        let mut status = interval(STATUS_PERIOD);
        status.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut ping = interval(PING_PERIOD);
        let mut heard = Instant::now();
        loop {
            let sent = tokio::select! {
                () = end_of(&mut stopped) => return Some(End::new(code::STOPPED, "the rig ends")),
                received = socket.recv() => {
                    heard = Instant::now();
                    match received {
                        Some(Ok(Frame::Text(text))) => match self.take(&text).await {
                            Ok(Done::Quietly) => Ok(()),
                            Ok(Done::Steered) => {
                                status.reset_immediately();
                                Ok(())
                            }
                            Ok(Done::News(news)) => send(socket, &Answer::Signals(news)).await,
                            Ok(Done::Problem(message)) => send(socket, &Answer::Problem { message }).await,
                            Err(end) => return Some(end),
                        },
                        Some(Ok(Frame::Binary(_))) => return Some(End::new(code::BAD_MESSAGE, "a binary message")),
                        Some(Ok(Frame::Ping(_) | Frame::Pong(_))) => Ok(()),
                        Some(Ok(Frame::Close(_)) | Err(_)) | None => return None,
                    }
                }
                message = self.messages.recv() => match message {
                    Some(Message::Image(bytes)) => socket.send(Frame::Binary(bytes)).await,
                    Some(Message::Geometry(geometry)) => send(socket, &Answer::Geometry(&geometry)).await,
                    Some(Message::Measure(measured)) => send(socket, &Answer::Measure(&measured)).await,
                    Some(Message::Pixel(answer)) => send(socket, &Answer::Pixel(answer)).await,
                    Some(Message::Problem(message)) => send(socket, &Answer::Problem { message }).await,
                    None => return None,
                },
                _ = status.tick() => {
                    let rig = Arc::clone(&self.view.rig);
                    match tokio::task::spawn_blocking(move || rig.status()).await {
                        Ok(status) => send(socket, &Answer::Status(&status)).await,
                        Err(_) => return None,
                    }
                }
                _ = ping.tick() => {
                    if heard.elapsed() > SILENCE {
                        return None;
                    }
                    socket.send(Frame::Ping(axum::body::Bytes::new())).await
                }
            };
            if sent.is_err() {
                return None;
            }
        }
    }

    /// Does what the client asks for.
    async fn take(&self, text: &str) -> Result<Done, End> {
        let request = serde_json::from_str(text).map_err(|e| End::new(code::BAD_MESSAGE, e.to_string()))?;
        let problem = |e: crate::Error| Done::Problem(e.to_string());
        Ok(match request {
            // On the socket none is needed, and one more does no harm.
            Request::Token(_) => Done::Quietly,
            Request::Watch(wanted) => self.place.watch(&wanted).map_or_else(problem, |()| Done::Quietly),
            Request::Credit(images) => {
                self.place.credit(images);
                Done::Quietly
            }
            Request::Pixel(question) => {
                self.place.ask(question);
                Done::Quietly
            }
            Request::Signals(shown) => {
                let place = self.signals.clone();
                let show = move || match (place, shown) {
                    (Some(place), Some(shown)) => place.show(&shown).map(Some),
                    (place, _) => {
                        place.inspect(|place| place.leave());
                        Ok(None)
                    }
                };
                match tokio::task::spawn_blocking(show).await {
                    Ok(Ok(Some(news))) => Done::News(news),
                    Ok(Ok(None)) => Done::Quietly,
                    Ok(Err(e)) => problem(e),
                    Err(_) => failed_inside(),
                }
            }
            Request::Replay(steer) => {
                let rig = Arc::clone(&self.view.rig);
                let steered =
                    tokio::task::spawn_blocking(move || rig.replay().map(|replay| steer.apply(replay))).await;
                match steered {
                    Ok(Some(Ok(_))) => Done::Steered,
                    Ok(Some(Err(e))) => problem(e),
                    Ok(None) => Done::Problem("this page shows cameras and no recording".to_owned()),
                    Err(_) => failed_inside(),
                }
            }
        })
    }
}

/// Effect of a client's message.
enum Done {
    Quietly,
    /// The status has changed.
    Steered,
    News(News),
    Problem(String),
}

fn failed_inside() -> Done {
    Done::Problem("the call failed inside the daemon; its log says more".to_owned())
}

impl Drop for Client {
    fn drop(&mut self) {
        let place = self.signals.take();
        // Closing channels takes a moment.
        drop(tokio::task::spawn_blocking(move || drop(place)));
    }
}

async fn send(socket: &mut WebSocket, answer: &Answer<'_>) -> Result<(), axum::Error> {
    let text = serde_json::to_string(answer).map_err(axum::Error::new)?;
    socket.send(Frame::Text(text.into())).await
}
