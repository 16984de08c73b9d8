//! The connection: a request to the control socket that changes what the connection speaks.

use super::PROTOCOL;
use crate::api::ErrorBody;
use depthrig_bus::StreamId;
use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;

/// The longest head and body of an answer.
const MAX_ANSWER_BYTES: usize = 16 << 10;

/// A connection to the daemon behind `socket` on which frames of `id` can be asked for. `read` reads from it, until its own limit of time.
///
/// # Errors
/// Those of the socket, and what the daemon answers.
pub(super) fn connect(
    socket: &Path,
    id: &StreamId,
    read: &dyn Fn(&mut UnixStream, &mut [u8]) -> io::Result<()>,
) -> io::Result<UnixStream> {
    let mut stream = UnixStream::connect(socket)?;
    let request = format!(
        "GET /v1/frames/{id} HTTP/1.1\r\nhost: localhost\r\nconnection: upgrade\r\nupgrade: {PROTOCOL}\r\n\r\n"
    );
    stream.write_all(request.as_bytes())?;
    // Byte by byte: what follows the head is not of HTTP any more.
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        read(&mut stream, &mut byte)?;
        head.push(byte[0]);
        if head.len() > MAX_ANSWER_BYTES {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "the answer does not end"));
        }
    }
    let head = String::from_utf8_lossy(&head).to_ascii_lowercase();
    if head.starts_with("http/1.1 101 ") {
        return Ok(stream);
    }
    let length =
        head.lines().find_map(|line| line.strip_prefix("content-length:")?.trim().parse::<usize>().ok());
    let mut body = Vec::new();
    stream.take(length.unwrap_or_default().min(MAX_ANSWER_BYTES) as u64).read_to_end(&mut body)?;
    let said = serde_json::from_slice::<ErrorBody>(&body).map(|body| body.error.message);
    Err(io::Error::other(said.unwrap_or_else(|_| head.lines().next().unwrap_or_default().to_owned())))
}
