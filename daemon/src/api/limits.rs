//! Time limits of a connection: a client that stops half way holds nothing for long.
//!
//! hyper limits the time for a request's head. The body is read here in full before the call sees it; an
//! answer that the client does not read is limited in [`Limited`].

use super::MAX_BODY_BYTES;
use super::reply::Refusal;
use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::extract::ws::{CloseFrame, Message, WebSocket};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use core::future::Future;
use core::pin::Pin;
use core::task::{Context, Poll};
use core::time::Duration;
use std::io::{self, IoSlice};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::watch;
use tokio::time::Sleep;

/// How long a client may take to send the head of its next request; an idle connection ends after it.
pub(super) const HEAD_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a client may take to send the body of a request.
const BODY_TIMEOUT: Duration = Duration::from_secs(5);
/// How long a client may take to read an answer.
pub(super) const WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// Most time that a client may take to answer the end of its WebSocket.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Ends a WebSocket with a code and a reason, and reads what its client still says until it has heard them: a connection that is closed with bytes
/// unread is reset, and the reason can be lost with it.
pub(super) async fn close(socket: &mut WebSocket, code: u16, reason: &str) {
    let reason = reason.into();
    let ended = async {
        if socket.send(Message::Close(Some(CloseFrame { code, reason }))).await.is_ok() {
            while let Some(Ok(_)) = socket.recv().await {}
        }
    };
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, ended).await;
}

/// Reads the body within its limits of time and size.
pub(super) async fn whole_body(request: Request, next: Next) -> Response {
    let (parts, body) = request.into_parts();
    let read = tokio::time::timeout(BODY_TIMEOUT, to_bytes(body, MAX_BODY_BYTES)).await;
    let refusal = match read {
        Ok(Ok(bytes)) => return next.run(Request::from_parts(parts, Body::from(bytes))).await,
        Ok(Err(_)) => {
            let message = format!("the body cannot be read, or is longer than {MAX_BODY_BYTES} bytes");
            Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, message)
        }
        Err(_) => {
            let seconds = BODY_TIMEOUT.as_secs();
            Refusal::new(StatusCode::REQUEST_TIMEOUT, format!("the body did not come within {seconds} s"))
        }
    };
    refusal.into_response()
}

/// Waits until the service is to end.
pub(super) async fn end_of(stopped: &mut watch::Receiver<bool>) {
    // An error means that the handle is gone, which is an end as well.
    let _ = stopped.wait_for(|stopped| *stopped).await;
}

/// A stream whose peer must read in time: the clock runs from the first byte that it does not take until it has taken
/// all.
pub(super) struct Limited<S> {
    stream: S,
    timeout: Duration,
    blocked: Option<Pin<Box<Sleep>>>,
}

impl<S> Limited<S> {
    pub(super) const fn new(stream: S, timeout: Duration) -> Self {
        Self { stream, timeout, blocked: None }
    }

    /// The stream, without limits.
    pub(super) fn into_inner(self) -> S {
        self.stream
    }

    /// `wrote` unless the time is up; `len` bytes were to be written.
    fn judge(
        &mut self,
        cx: &mut Context<'_>,
        wrote: Poll<io::Result<usize>>,
        len: usize,
    ) -> Poll<io::Result<usize>> {
        if matches!(wrote, Poll::Ready(Ok(n)) if n == len) || matches!(wrote, Poll::Ready(Err(_))) {
            self.blocked = None;
            return wrote;
        }
        let timeout = self.timeout;
        let timer = self.blocked.get_or_insert_with(|| Box::pin(tokio::time::sleep(timeout)));
        if timer.as_mut().poll(cx).is_ready() {
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        wrote
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Limited<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Limited<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let wrote = Pin::new(&mut self.stream).poll_write(cx, buf);
        self.judge(cx, wrote, buf.len())
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let wrote = Pin::new(&mut self.stream).poll_write_vectored(cx, bufs);
        self.judge(cx, wrote, bufs.iter().map(|b| b.len()).sum())
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::future::poll_fn;
    use std::io::Read;
    use std::os::unix::net::UnixStream;

    /// Writes `len` bytes for a peer that reads 4 KiB and then sleeps.
    fn write_for(sleep: Duration, len: usize) -> io::Result<()> {
        let (ours, mut theirs) = UnixStream::pair().unwrap();
        let reader = std::thread::spawn(move || {
            let mut piece = [0; 4096];
            while theirs.read(&mut piece).is_ok_and(|n| n > 0) {
                std::thread::sleep(sleep);
            }
        });
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let wrote = runtime.block_on(async {
            ours.set_nonblocking(true).unwrap();
            let stream = tokio::net::UnixStream::from_std(ours).unwrap();
            let mut writer = Limited::new(stream, Duration::from_secs(2));
            let bytes = vec![7; len];
            let mut left = &bytes[..];
            while !left.is_empty() {
                let n = poll_fn(|cx| Pin::new(&mut writer).poll_write(cx, left)).await?;
                left = &left[n..];
            }
            Ok(())
        });
        reader.join().unwrap();
        wrote
    }

    /// The slow peer would need a minute, so that it always takes something, and never all of it.
    #[test]
    fn who_reads_too_slowly_is_cut_off_and_nobody_else() {
        write_for(Duration::ZERO, 4 << 20).unwrap();
        let slow = write_for(Duration::from_millis(60), 4 << 20);
        assert_eq!(slow.unwrap_err().kind(), io::ErrorKind::TimedOut);
    }
}
