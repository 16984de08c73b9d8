//! The process's umask, which iceoryx2 changes while it binds the socket of a listener.
//!
//! It sets the umask, binds, and sets it back. The umask belongs to the process: two threads that bind at once can leave
//! it at 0177, and from then on nobody but root can enter a new folder. Between the two calls, a thread that creates a
//! folder or starts a program also gets that umask. So binding happens on a thread with a umask of its own, one at a
//! time; where the kernel refuses such a thread (containers that forbid `unshare`), whatever creates folders or starts
//! programs waits for the same lock.

use crate::sync::lock;
use rustix::fs::Mode;
use std::io;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, Once, OnceLock};

/// Held while the umask may be changed, and by operations that depend on it.
static CHANGING: Mutex<()> = Mutex::new(());
/// The umask that the process had at first, less what keeps the owner out.
static OWN: OnceLock<u32> = OnceLock::new();
/// Permissions that a folder's owner must keep.
const OWNER: u32 = 0o700;

/// Keeps the umask unchanged until dropped, for starting programs and creating folders.
#[must_use]
#[derive(Debug)]
pub struct Steady(#[allow(dead_code)] MutexGuard<'static, ()>);

/// Waits until nothing changes the umask, then locks it.
pub fn steady() -> Steady {
    Steady(lock(&CHANGING))
}

/// Runs `bind`, which may change the umask for a moment, where no other thread sees it.
pub(crate) fn apart<T: Send>(bind: impl Fn() -> T + Sync) -> T {
    let _steady = steady();
    let done = std::thread::scope(|scope| {
        let run = || own_umask().then(&bind);
        let thread = std::thread::Builder::new().name("bind".into()).spawn_scoped(scope, run);
        thread.ok().and_then(|thread| thread.join().ok().flatten())
    });
    done.unwrap_or_else(bind)
}

/// Gives the calling thread a umask (and a working folder) of its own, if the kernel permits it.
#[allow(unsafe_code)]
fn own_umask() -> bool {
    // SAFETY: of what `unshare` can take apart only FILES endangers memory or descriptors; FS does neither.
    unsafe { rustix::thread::unshare_unsafe(rustix::thread::UnshareFlags::FS) }.is_ok()
}

/// Creates the folder `path` and those above it, with the modes that the user's umask gives.
///
/// # Errors
/// Those of the file system.
pub fn create_dir_all(path: &Path) -> io::Result<()> {
    let steady = steady();
    mend(&steady);
    std::fs::create_dir_all(path)
}

/// Restores the process's first umask if the current one keeps the owner out of new folders.
pub fn check() {
    mend(&steady());
}

fn mend(_steady: &Steady) {
    static LOGGED: Once = Once::new();
    let Some(now) = current() else { return };
    let own = *OWN.get_or_init(|| now & !OWNER);
    if now & OWNER == 0 {
        return;
    }
    rustix::process::umask(Mode::from_bits_truncate(own));
    LOGGED.call_once(|| {
        tracing::warn!(
            "the umask was {now:04o}, with which nobody but root can enter new folders; it is {own:04o} again (a library \
             changed it, or the daemon was started with it)"
        );
    });
}

/// The umask, read without changing it.
fn current() -> Option<u32> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let text = status.lines().find_map(|line| line.strip_prefix("Umask:"))?;
    u32::from_str_radix(text.trim(), 8).ok()
}
