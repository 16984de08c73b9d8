//! The thread that serves: it accepts, keeps connections few and short-lived, and ends within half a second.

use super::events::Events;
use super::limits::{HEAD_TIMEOUT, Limited, WRITE_TIMEOUT, end_of};
use super::live::Live;
use super::page::PageAddress;
use super::socket::{self, SocketFile};
use super::token::{self, Token};
use super::{MAX_CONNECTIONS, foxglove, frames, guard, routes};
use crate::config::ControlConfig;
use crate::control::Control;
use crate::foxglove::Foxglove;
use crate::viewers::{SignalFeed, Viewers};
use crate::{Error, ErrorKind, Result};
use axum::{Extension, Router};
use core::time::Duration;
use depthrig_bus::{RigName, RuntimeDir};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, UnixListener};
use tokio::sync::{Semaphore, watch};

/// Time that requests under way get when the service ends, and clients to hear that it ends.
const STOP_TIMEOUT: Duration = Duration::from_millis(500);
/// The pause after a connection could not be accepted, which is when the process is out of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Threads for calls of `Control`.
const CALL_THREADS: usize = 8;

/// The running service; dropping it ends the service.
#[derive(Debug)]
pub struct ServerHandle {
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    tcp: Option<SocketAddr>,
    token: Option<Arc<Token>>,
    _socket: SocketFile,
}

impl ServerHandle {
    pub(super) fn start(
        control: Arc<dyn Control>,
        runtime_dir: &RuntimeDir,
        rig: &RigName,
        ports: ControlConfig,
    ) -> Result<Self> {
        let path = runtime_dir.socket_path(rig);
        let failed = |e: std::io::Error| {
            Error::new(ErrorKind::Other, format!("the control API cannot be served: {e}")).with_source(e)
        };
        // The ports first: when one is refused, no socket has come and gone.
        let port = socket::bind_port(ports.tcp, "control.tcp")?;
        let foxglove = socket::bind_port(ports.foxglove, "control.foxglove")?;
        let (unix, socket) = socket::bind_unix(&path)?;
        let address_of = |port: &Option<std::net::TcpListener>| {
            port.as_ref().map(std::net::TcpListener::local_addr).transpose().map_err(failed)
        };
        let tcp = address_of(&port)?;
        let foxglove_tcp = address_of(&foxglove)?;
        let token = tcp.or(foxglove_tcp).map(|_| Token::create(path.with_extension("token"))).transpose()?;
        let mut builder = tokio::runtime::Builder::new_current_thread();
        let runtime = builder.enable_all().max_blocking_threads(CALL_THREADS).thread_name("api-call").build();
        let runtime = runtime.map_err(failed)?;
        let listeners = {
            let _inside = runtime.enter();
            let on_port = |port: Option<std::net::TcpListener>| -> Result<Option<OnPort>> {
                let port = port.map(TcpListener::from_std).transpose().map_err(failed)?;
                Ok(port.zip(token.clone()).map(|(listener, token)| OnPort { listener, token }))
            };
            let port = on_port(port)?;
            let foxglove = on_port(foxglove)?;
            Listeners { unix: UnixListener::from_std(unix).map_err(failed)?, port, foxglove }
        };
        let (stop, stopped) = watch::channel(false);
        let viewers = Viewers::new(runtime_dir.clone(), rig.clone());
        let signals = SignalFeed::new(runtime_dir.clone());
        let foxglove = Foxglove::new(runtime_dir.clone(), rig.clone(), Arc::clone(&control));
        let address = PageAddress::of(tcp, foxglove_tcp, token.as_deref().map(Token::path));
        let frames = frames::Served { runtime: runtime_dir.clone(), rig: rig.clone() };
        let served = Served { control, frames, viewers, signals, foxglove, address, stopped };
        let serve = move || {
            runtime.block_on(run(served, listeners));
            // A call that is still under way ends by itself; nobody waits for its answer.
            runtime.shutdown_background();
        };
        let thread = std::thread::Builder::new().name("api".into()).spawn(serve).map_err(failed)?;
        tracing::debug!(socket = %path.display(), tcp = ?tcp, "control API is served");
        Ok(Self { stop, thread: Some(thread), tcp, token, _socket: socket })
    }

    /// The file with the token that requests over TCP carry, if a port is served.
    pub fn token_path(&self) -> Option<&Path> {
        self.token.as_deref().map(Token::path)
    }

    /// The address of the loopback port, if one is served.
    pub const fn tcp(&self) -> Option<SocketAddr> {
        self.tcp
    }

    /// Ends the service: no new requests, half a second for those under way, then the socket's file goes.
    pub fn stop(self) {
        drop(self);
    }
}

impl Drop for ServerHandle {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread of the control API had panicked");
        }
    }
}

/// A loopback port with the token that its clients must know.
struct OnPort {
    listener: TcpListener,
    token: Arc<Token>,
}

/// Where requests come in.
struct Listeners {
    unix: UnixListener,
    port: Option<OnPort>,
    foxglove: Option<OnPort>,
}

/// The rig, and what serves it.
struct Served {
    control: Arc<dyn Control>,
    frames: frames::Served,
    viewers: Viewers,
    signals: SignalFeed,
    foxglove: Foxglove,
    address: PageAddress,
    stopped: watch::Receiver<bool>,
}

async fn run(served: Served, listeners: Listeners) {
    let Served { control, frames, viewers, signals, foxglove, address, stopped } = served;
    let Listeners { unix, port, foxglove: foxglove_port } = listeners;
    let pages = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let live = |token: Option<Arc<Token>>| {
        let places = Arc::clone(&pages);
        Extension(Live {
            viewers: viewers.clone(),
            signals: signals.clone(),
            stopped: stopped.clone(),
            places,
            token,
        })
    };
    let rig = Arc::clone(&control);
    let router = routes::router(control, Events::new(stopped.clone()))
        .layer(Extension(address))
        .layer(Extension(frames))
        .layer(axum::middleware::from_fn(guard::own_origin))
        .layer(axum::middleware::from_fn(guard::loopback_host));
    // Connections of the port are anybody's on this computer: they must not take the places of the socket.
    let port_places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let on_port = async {
        if let Some(OnPort { listener, token }) = port {
            let guarded = router
                .clone()
                .layer(live(Some(Arc::clone(&token))))
                .layer(axum::middleware::from_fn_with_state(token, token::bearer));
            let places = Arc::clone(&port_places);
            let acceptor =
                Acceptor { places, router: guarded, stopped: stopped.clone(), write_timeout: WRITE_TIMEOUT };
            acceptor.run(async || listener.accept().await.map(|(stream, _)| stream)).await;
        }
    };
    let foxglove_places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let on_foxglove = async {
        if let Some(OnPort { listener, token }) = foxglove_port {
            let places = Arc::clone(&pages);
            let viewers = foxglove::Service { foxglove, rig, stopped: stopped.clone(), places, token };
            let acceptor = Acceptor {
                places: Arc::clone(&foxglove_places),
                router: foxglove::router(viewers),
                stopped: stopped.clone(),
                write_timeout: foxglove::WRITE_TIMEOUT,
            };
            acceptor.run(async || foxglove::accept(&listener).await).await;
        }
    };
    let on_socket = Acceptor {
        places: Arc::clone(&places),
        router: router.clone().layer(live(None)),
        stopped: stopped.clone(),
        write_timeout: WRITE_TIMEOUT,
    };
    let on_socket = on_socket.run(async || unix.accept().await.map(|(stream, _)| stream));
    tokio::join!(on_port, on_foxglove, on_socket);
    let all = async {
        let _ = places.acquire_many(MAX_CONNECTIONS as u32).await;
        let _ = port_places.acquire_many(MAX_CONNECTIONS as u32).await;
        let _ = foxglove_places.acquire_many(MAX_CONNECTIONS as u32).await;
        let _ = pages.acquire_many(MAX_CONNECTIONS as u32).await;
    };
    if tokio::time::timeout(STOP_TIMEOUT, all).await.is_err() {
        tracing::debug!("requests under way were cut off because the rig ends");
    }
}

struct Acceptor {
    places: Arc<Semaphore>,
    router: Router,
    stopped: watch::Receiver<bool>,
    /// How long a client may take to read an answer.
    write_timeout: Duration,
}

impl Acceptor {
    /// Serves what `next` accepts until the service is stopped.
    async fn run<S>(mut self, next: impl AsyncFn() -> std::io::Result<S>)
    where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        loop {
            let accepted = async {
                let stream = next().await;
                (stream, Arc::clone(&self.places).acquire_owned().await)
            };
            let (stream, place) = tokio::select! {
                () = end_of(&mut self.stopped) => return,
                accepted = accepted => accepted,
            };
            let (Ok(stream), Ok(place)) = (stream, place) else {
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            };
            let router = self.router.clone();
            let stopped = self.stopped.clone();
            let stream = Limited::new(stream, self.write_timeout);
            tokio::spawn(async move {
                converse(stream, router, stopped).await;
                drop(place);
            });
        }
    }
}

/// Answers the requests of one connection. A client that goes away or talks nonsense concerns only itself.
async fn converse<S>(stream: S, router: Router, mut stopped: watch::Receiver<bool>)
where
    S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
{
    let mut http = hyper::server::conn::http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(HEAD_TIMEOUT);
    let connection =
        http.serve_connection(TokioIo::new(stream), TowerToHyperService::new(router)).with_upgrades();
    tokio::pin!(connection);
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = end_of(&mut stopped) => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(e) = ended {
        tracing::debug!(error = %e, "a connection of the control API ended early");
    }
}
