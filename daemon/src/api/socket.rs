//! Binding the two places where the API is served.

use crate::config::Port;
use crate::{Error, ErrorKind, Result};
use rustix::fs::{FileType, Mode};
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};

/// The socket's file; dropping it removes the file if it is still this one.
#[derive(Debug)]
pub(super) struct SocketFile {
    path: PathBuf,
    /// Device and inode.
    id: (u64, u64),
}

/// Binds the Unix socket `path` with mode 0600, over the rest of a process that died if there is one.
pub(super) fn bind_unix(path: &Path) -> Result<(UnixListener, SocketFile)> {
    make_way(path)?;
    let failed = |what: &str, e: io::Error| {
        let kind = match e.kind() {
            io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
                ErrorKind::PermissionDenied
            }
            io::ErrorKind::StorageFull => ErrorKind::NoSpace,
            _ => ErrorKind::Other,
        };
        Error::new(kind, format!("control socket {}: {what}: {e}", path.display())).with_source(e)
    };
    // Between these two calls the folder's mode (0700) is what keeps others out.
    let listener = UnixListener::bind(path).map_err(|e| failed("it cannot be created", e))?;
    rustix::fs::chmod(path, Mode::RUSR | Mode::WUSR)
        .map_err(|e| failed("its mode cannot be set", e.into()))?;
    let stat = rustix::fs::lstat(path).map_err(|e| failed("it cannot be read", e.into()))?;
    listener.set_nonblocking(true).map_err(|e| failed("it cannot be served", e))?;
    Ok((listener, SocketFile { path: path.to_owned(), id: (stat.st_dev, stat.st_ino) }))
}

/// Removes a socket that nobody listens on; anything else is left alone.
fn make_way(path: &Path) -> Result<()> {
    let shown = path.display();
    let Ok(stat) = rustix::fs::lstat(path) else { return Ok(()) };
    if FileType::from_raw_mode(stat.st_mode) != FileType::Socket {
        let message =
            format!("control socket {shown}: a file that is not a socket is in the way; move it elsewhere");
        return Err(Error::new(ErrorKind::InUse, message));
    }
    if UnixStream::connect(path).is_ok() {
        let message = format!("control socket {shown}: another process answers on it; stop that one first");
        return Err(Error::new(ErrorKind::InUse, message));
    }
    tracing::info!(socket = %shown, "removing the control socket of a daemon that did not end cleanly");
    std::fs::remove_file(path).map_err(|e| {
        let message = format!("control socket {shown}: the one of an earlier daemon cannot be removed: {e}");
        Error::new(ErrorKind::PermissionDenied, message).with_source(e)
    })
}

/// Binds the port that `key` of the rig file configures. With [`Port::Any`] a rig runs without one if no port is free.
pub(super) fn bind_port(port: Port, key: &str) -> Result<Option<TcpListener>> {
    match port {
        Port::Off => Ok(None),
        Port::At(address) => bind_tcp(address, key).map(Some),
        Port::Any => {
            let another = SocketAddr::new(Port::DEFAULT.ip(), 0);
            let bound = bind_tcp(Port::DEFAULT, key).or_else(|_| bind_tcp(another, key));
            if let Err(e) = &bound {
                tracing::warn!(error = %e, "the live page is not served");
            }
            Ok(bound.ok())
        }
    }
}

/// Binds the loopback address `address`.
fn bind_tcp(address: SocketAddr, key: &str) -> Result<TcpListener> {
    if !address.ip().is_loopback() {
        let message =
            format!("control address {address} is not loopback; the API is not encrypted, use 127.0.0.1");
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    let bound = TcpListener::bind(address).and_then(|l| l.set_nonblocking(true).map(|()| l));
    bound.map_err(|e| {
        let (kind, what) = match e.kind() {
            io::ErrorKind::AddrInUse => {
                (ErrorKind::InUse, format!("another program listens there; change or remove {key}"))
            }
            io::ErrorKind::PermissionDenied => {
                (ErrorKind::PermissionDenied, "this user may not; choose a port above 1023".to_owned())
            }
            _ => (ErrorKind::Other, "it cannot be served".to_owned()),
        };
        Error::new(kind, format!("control address {address}: {what}: {e}")).with_source(e)
    })
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        let ours = rustix::fs::lstat(&self.path).is_ok_and(|s| (s.st_dev, s.st_ino) == self.id);
        if ours && let Err(e) = std::fs::remove_file(&self.path) {
            tracing::warn!(socket = %self.path.display(), error = %e, "the control socket cannot be removed");
        }
    }
}
