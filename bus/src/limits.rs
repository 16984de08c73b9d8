//! Finds the exhausted limit of the process when iceoryx2 only reports that it could not create something.

use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};

/// A port opens some descriptors at a time and closes them again when one of them fails.
const NEEDED: u64 = 16;

/// `otherwise`, or that this process is out of file descriptors, if it is.
pub fn why(otherwise: &str) -> String {
    descriptors().unwrap_or_else(|| otherwise.to_owned())
}

/// Advice when so few file descriptors are left that opening a port can fail.
pub fn descriptors() -> Option<String> {
    let most = getrlimit(Resource::Nofile).current?;
    let open = match std::fs::read_dir("/proc/self/fd") {
        Ok(entries) => entries.count() as u64,
        Err(e) => match Errno::from_io_error(&e) {
            Some(Errno::MFILE | Errno::NFILE) => most,
            _ => return None,
        },
    };
    (open + NEEDED > most).then(|| {
        format!(
            "this process has {open} of at most {most} file descriptors open; close subscribers or files that are not \
             needed, or raise the limit (ulimit -n, or LimitNOFILE= of its service)"
        )
    })
}
