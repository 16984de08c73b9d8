//! The WebSocket for viewers with Foxglove's protocol, on a port of its own: those viewers ask for an address and nothing else.
//!
//! The protocol knows no authentication, and every user of the computer reaches a loopback port. So the path of the address is the rig's token,
//! which only the user that runs the rig can read. With it a page of any origin may connect: viewers in a browser come from other servers, those on the desktop from
//! `file://`, and a page that was not given the address cannot guess it.

use super::guard;
use super::limits::{close, end_of};
use super::reply::Refusal;
use super::token::Token;
use crate::control::Control;
use crate::foxglove::{
    Content, Foxglove, FromClient, Next, Place, SERVICE_ENCODINGS, SUBPROTOCOLS, Scene, ServiceCall,
    ToClient, advertise_services, call_service,
};
use axum::Router;
use axum::body::Bytes;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use core::time::Duration;
use std::collections::BTreeSet;
use std::io;
use std::sync::Arc;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::time::{Instant, MissedTickBehavior, interval};

/// How long a client may read nothing of what was sent to it; a viewer connects again by itself.
pub(super) const WRITE_TIMEOUT: Duration = Duration::from_secs(30);
/// Bytes that the kernel keeps for a client that does not read.
const SEND_BUFFER_BYTES: usize = 256 << 10;
/// The longest message of a client, bytes: a subscription to each of some hundred channels.
const MAX_MESSAGE_BYTES: usize = 64 << 10;
/// Between two looks at the streams of the rig.
const LOOK_PERIOD: Duration = Duration::from_secs(1);
const PING_PERIOD: Duration = Duration::from_secs(5);
/// A client that sends nothing for so long, not even an answer to a ping, has gone.
const SILENCE: Duration = Duration::from_secs(30);
/// Calls of a client that may be under way.
const MAX_CALLS: usize = 4;

/// Codes with which the server closes (RFC 6455).
mod code {
    pub(super) const STOPPED: u16 = 1001;
    pub(super) const BAD_MESSAGE: u16 = 1008;
    pub(super) const FULL: u16 = 1013;
}

/// The surroundings of the connections.
#[derive(Clone)]
pub(super) struct Service {
    pub(super) foxglove: Foxglove,
    pub(super) rig: Arc<dyn Control>,
    /// True when the service ends.
    pub(super) stopped: watch::Receiver<bool>,
    /// One for each connection: what has been upgraded has left the places of the port.
    pub(super) places: Arc<Semaphore>,
    pub(super) token: Arc<Token>,
}

/// The port's only path, and an explanation on all others.
pub(super) fn router(service: Service) -> Router {
    Router::new()
        .route("/{token}", get(upgrade))
        .fallback(wrong_address)
        .with_state(service)
        .layer(axum::middleware::from_fn(guard::loopback_host))
}

/// Accepts a connection whose kernel buffer is small, so that what waits in it is not old.
pub(super) async fn accept(listener: &TcpListener) -> io::Result<TcpStream> {
    let (stream, _) = listener.accept().await?;
    rustix::net::sockopt::set_socket_send_buffer_size(&stream, SEND_BUFFER_BYTES)?;
    // A message is complete when it is written; nothing follows that could go with it.
    stream.set_nodelay(true)?;
    Ok(stream)
}

async fn wrong_address() -> Refusal {
    let message =
        "this port is for viewers with Foxglove's protocol; `depthrig open --foxglove` prints their address";
    Refusal::denied(StatusCode::UNAUTHORIZED, message)
}

async fn upgrade(
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
    Path(given): Path<String>,
    State(service): State<Service>,
) -> Response {
    if !service.token.is(&given) {
        return wrong_address().await.into_response();
    }
    let Ok(held) = Arc::clone(&service.places).try_acquire_owned() else {
        return Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "too many viewers are connected; close one")
            .into_response();
    };
    let upgrade = upgrade.map(|u| u.protocols(SUBPROTOCOLS).max_message_size(MAX_MESSAGE_BYTES));
    match upgrade {
        Ok(upgrade) if upgrade.selected_protocol().is_some() => upgrade.on_upgrade(async move |socket| {
            serve(socket, service).await;
            drop(held);
        }),
        _ => {
            let known = SUBPROTOCOLS.join(" or ");
            let message =
                format!("this is a WebSocket of the sub-protocol {known}; open it in Foxglove or Lichtblick");
            Refusal::new(StatusCode::BAD_REQUEST, message).into_response()
        }
    }
}

/// Why a connection ends.
struct End {
    code: u16,
    reason: &'static str,
}

async fn serve(mut socket: WebSocket, service: Service) {
    let Service { foxglove, rig, stopped, .. } = service;
    let end = match foxglove.enter() {
        Some(place) => {
            let (answers, answered) = mpsc::channel(MAX_CALLS);
            let client = Client { foxglove, rig, place, announced: BTreeSet::new(), answers };
            client.serve(&mut socket, answered, stopped).await
        }
        None => Some(End { code: code::FULL, reason: "too many viewers are connected; close one" }),
    };
    if let Some(End { code, reason }) = end {
        close(&mut socket, code, reason).await;
    }
}

/// A connected viewer.
struct Client {
    foxglove: Foxglove,
    rig: Arc<dyn Control>,
    place: Place,
    /// Numbers of the channels that it knows.
    announced: BTreeSet<u32>,
    /// Where answers to its calls come from.
    answers: mpsc::Sender<Message>,
}

impl Client {
    /// Serves until one side ends; `None` when the client has gone.
    async fn serve(
        mut self,
        socket: &mut WebSocket,
        mut answered: mpsc::Receiver<Message>,
        mut stopped: watch::Receiver<bool>,
    ) -> Option<End> {
        self.greet(socket).await.ok()?;
        let mut look = interval(LOOK_PERIOD);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut ping = interval(PING_PERIOD);
        ping.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut heard = Instant::now();
        loop {
            let sent = tokio::select! {
                () = end_of(&mut stopped) => {
                    return Some(End { code: code::STOPPED, reason: "the rig ends" });
                }
                received = socket.recv() => {
                    heard = Instant::now();
                    match received {
                        Some(Ok(Message::Text(text))) => match serde_json::from_str(&text) {
                            Ok(message) => self.take(socket, message).await,
                            Err(_) => return Some(End { code: code::BAD_MESSAGE, reason: "the message is not understood" }),
                        },
                        Some(Ok(Message::Binary(bytes))) => match ServiceCall::read(&bytes) {
                            Some(call) => self.call(socket, call).await,
                            None => return Some(End { code: code::BAD_MESSAGE, reason: "only services may be called" }),
                        },
                        Some(Ok(Message::Pong(payload))) => {
                            if let Ok(number) = <[u8; 8]>::try_from(&payload[..]) {
                                self.place.answered(u64::from_le_bytes(number));
                            }
                            Ok(())
                        }
                        Some(Ok(Message::Ping(_))) => Ok(()),
                        Some(Ok(Message::Close(_)) | Err(_)) | None => return None,
                    }
                }
                () = self.place.woken() => self.send_next(socket).await,
                Some(answer) = answered.recv() => socket.send(answer).await,
                _ = look.tick() => self.announce(socket).await,
                _ = ping.tick() => {
                    if heard.elapsed() > SILENCE {
                        return None;
                    }
                    socket.send(Message::Ping(Bytes::new())).await
                }
            };
            if sent.is_err() {
                return None;
            }
        }
    }

    async fn greet(&mut self, socket: &mut WebSocket) -> Result<(), axum::Error> {
        let rig = self.foxglove.rig();
        let info = ToClient::ServerInfo {
            name: format!("depthrig {rig}"),
            capabilities: &["services"],
            supported_encodings: &SERVICE_ENCODINGS,
            session_id: format!("{}-{rig}", std::process::id()),
        };
        send(socket, &info).await?;
        socket.send(Message::Text(advertise_services(rig).into())).await
    }

    /// Announces channels that have come, and withdraws those that have gone.
    async fn announce(&mut self, socket: &mut WebSocket) -> Result<(), axum::Error> {
        let foxglove = self.foxglove.clone();
        let scene = tokio::task::spawn_blocking(move || foxglove.scene()).await;
        let Ok(Some(scene)) = scene else { return Ok(()) };
        let present: BTreeSet<u32> = scene.numbers().collect();
        // First those that have gone: a viewer takes no second channel of a topic.
        let gone: Vec<u32> = self.announced.difference(&present).copied().collect();
        if !gone.is_empty() {
            self.place.withdraw(&gone);
            send(socket, &ToClient::Unadvertise { channel_ids: gone }).await?;
        }
        let new: Vec<u32> = present.difference(&self.announced).copied().collect();
        if !new.is_empty() {
            send_channels(socket, &scene, &new).await?;
        }
        self.announced = present;
        Ok(())
    }

    /// Sends one thing of what waits, and the ping that the client answers when it has read it.
    async fn send_next(&self, socket: &mut WebSocket) -> Result<(), axum::Error> {
        let Some(Next { number, content }) = self.place.next() else { return Ok(()) };
        match content {
            Content::Messages(messages) => {
                for message in messages {
                    socket.send(Message::Binary(message)).await?;
                }
            }
            Content::Problem(message) => send(socket, &ToClient::Status { level: 1, message }).await?,
        }
        socket.send(Message::Ping(number.to_le_bytes().to_vec().into())).await
    }

    /// Does what the client asks for.
    async fn take(&self, socket: &mut WebSocket, message: FromClient) -> Result<(), axum::Error> {
        match message {
            FromClient::Subscribe { subscriptions } => match self.place.subscribe(&subscriptions) {
                Ok(()) => Ok(()),
                Err(e) => send(socket, &ToClient::Status { level: 2, message: e.to_string() }).await,
            },
            FromClient::Unsubscribe { subscription_ids } => {
                self.place.unsubscribe(&subscription_ids);
                Ok(())
            }
            FromClient::Other => Ok(()),
        }
    }

    /// Calls a service; the answer comes when it is done.
    async fn call(&self, socket: &mut WebSocket, call: ServiceCall) -> Result<(), axum::Error> {
        let failure = |call: &ServiceCall, message: String| {
            let failure =
                ToClient::ServiceCallFailure { service_id: call.service, call_id: call.call, message };
            Message::Text(serde_json::to_string(&failure).unwrap_or_default().into())
        };
        let Ok(answer) = self.answers.clone().try_reserve_owned() else {
            return socket.send(failure(&call, "too many calls are under way".to_owned())).await;
        };
        let rig = Arc::clone(&self.rig);
        tokio::task::spawn_blocking(move || {
            answer.send(match call_service(&*rig, &call) {
                Ok(response) => Message::Binary(response.into()),
                Err(why) => failure(&call, why),
            });
        });
        Ok(())
    }
}

async fn send_channels(socket: &mut WebSocket, scene: &Scene, numbers: &[u32]) -> Result<(), axum::Error> {
    send(socket, &ToClient::Advertise { channels: scene.announced(numbers) }).await
}

async fn send(socket: &mut WebSocket, message: &ToClient<'_>) -> Result<(), axum::Error> {
    let text = serde_json::to_string(message).map_err(axum::Error::new)?;
    socket.send(Message::Text(text.into())).await
}
