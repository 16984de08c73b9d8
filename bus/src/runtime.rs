//! The private folder in which a user's rigs keep their files, and the lock of each rig.
//!
//! Policy: the daemon and all its subscribers run as **one user**. The folder is mode 0700 and everything of
//! iceoryx2 lives below it or is named after it, so that no other user's process can stall a camera and
//! depthrig never disturbs other iceoryx2 applications on the machine.

use crate::{Error, ErrorKind, Name, Result, RigName, umask};
use core::time::Duration;
use rustix::fs::{FileType, FlockOperation, Mode, OFlags, flock};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

/// The environment variable that moves the runtime folder.
pub const RUNTIME_DIR_VARIABLE: &str = "DEPTHRIG_RUNTIME_DIR";
/// iceoryx2 puts Unix sockets below the folder, and their paths have at most 107 bytes.
const MAX_PATH_LEN: usize = 40;
const LOCK_ATTEMPTS: u32 = 20;
/// Bytes that are read of a lock holder's description.
const MOST_OF_A_HOLDER: u64 = 256;
const LOCK_PAUSE: Duration = Duration::from_millis(5);

/// The private folder of a user's rigs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RuntimeDir(PathBuf);

impl RuntimeDir {
    /// The user's folder: `$DEPTHRIG_RUNTIME_DIR`, else `$XDG_RUNTIME_DIR/depthrig`, else
    /// `/tmp/depthrig-<uid>`. It is created if missing.
    ///
    /// # Errors
    /// As [`Self::at`].
    pub fn of_user() -> Result<Self> {
        let session = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|d| d.is_dir());
        let path = match (std::env::var_os(RUNTIME_DIR_VARIABLE), session) {
            (Some(dir), _) => PathBuf::from(dir),
            (None, Some(dir)) => dir.join("depthrig"),
            (None, None) => PathBuf::from(format!("/tmp/depthrig-{}", rustix::process::getuid().as_raw())),
        };
        Self::at(&path)
    }

    /// The folder `path`, created with mode 0700 if missing.
    ///
    /// # Errors
    /// [`ErrorKind::PermissionDenied`] when it belongs to another user or cannot be created,
    /// [`ErrorKind::LimitReached`] when its path is too long for the sockets below it.
    pub fn at(path: &Path) -> Result<Self> {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let shown = path.display();
        if path.as_os_str().len() > MAX_PATH_LEN {
            return Err(Error::new(
                ErrorKind::LimitReached,
                format!(
                    "runtime folder {shown}: the path is longer than {MAX_PATH_LEN} bytes, which leaves no room for \
                     the sockets below it; set {RUNTIME_DIR_VARIABLE} to a shorter one"
                ),
            ));
        }
        let denied = |what: &str| {
            Error::new(
                ErrorKind::PermissionDenied,
                format!("runtime folder {shown}: {what}; set {RUNTIME_DIR_VARIABLE} to a folder of your own"),
            )
        };
        let uid = rustix::process::getuid().as_raw();
        if let Some(link) = foreign_link(&path, uid) {
            return Err(denied(&format!("{} is a symbolic link of another user", link.display())));
        }
        umask::create_dir_all(&path).map_err(|e| denied("it cannot be created").with_source(e))?;
        // The open descriptor keeps the folder that was just checked or created, so that it cannot be replaced.
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let folder = rustix::fs::open(&path, flags, Mode::empty());
        let folder = folder.map_err(|e| denied("it cannot be opened").with_source(e))?;
        if let Some(link) = foreign_link(&path, uid) {
            return Err(denied(&format!("{} is a symbolic link of another user", link.display())));
        }
        let stat = rustix::fs::fstat(&folder).map_err(|e| denied("it cannot be read").with_source(e))?;
        if stat.st_uid != uid {
            return Err(denied(&format!(
                "it belongs to user {}, you are user {uid}, and a rig and its subscribers run as one user",
                stat.st_uid
            )));
        }
        rustix::fs::fchmod(&folder, Mode::RWXU)
            .map_err(|e| denied("its mode cannot be set").with_source(e))?;
        Ok(Self(path))
    }

    /// The folder's path.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The control socket of `rig`.
    pub fn socket_path(&self, rig: &RigName) -> PathBuf {
        self.0.join(format!("{rig}.sock"))
    }

    /// The socket on this computer that reaches the control socket of `rig` on another one.
    pub fn host_socket_path(&self, rig: &RigName, host: &Name) -> PathBuf {
        // Names have no `@`.
        self.0.join(format!("{rig}@{host}.sock"))
    }

    /// Rigs that run now: those whose lock is held.
    pub fn running_rigs(&self) -> Vec<RigName> {
        let Ok(entries) = std::fs::read_dir(&self.0) else { return Vec::new() };
        let mut rigs: Vec<_> = entries
            .filter_map(|e| {
                e.ok()?.file_name().to_str()?.strip_suffix(".lock").and_then(|n| RigName::new(n).ok())
            })
            .filter(|rig| self.holder(rig).is_some())
            .collect();
        rigs.sort();
        rigs
    }

    /// The process that runs `rig` now, in its own words.
    pub fn holder(&self, rig: &RigName) -> Option<String> {
        holder_of(&self.lock_path(rig))
    }

    /// Takes the lock of `rig` until the returned value is dropped; the process's end frees it, however it
    /// ends. `who` is shown to others that want it.
    ///
    /// # Errors
    /// [`ErrorKind::InUse`] naming the holder, [`ErrorKind::PermissionDenied`] when the file cannot be opened.
    pub fn lock(&self, rig: &RigName, who: &str) -> Result<RigLock> {
        let Some(file) = take(&self.lock_path(rig), who)? else {
            let holder = self.holder(rig).unwrap_or_else(|| "another process".to_owned());
            return Err(Error::new(
                ErrorKind::InUse,
                format!(
                    "rig \"{rig}\" is running already, held by {holder}; stop it first, or give this rig another name"
                ),
            ));
        };
        Ok(RigLock { _file: file })
    }

    fn lock_path(&self, rig: &RigName) -> PathBuf {
        self.0.join(format!("{rig}.lock"))
    }
}

/// The first part of `path` that is a symbolic link of neither `uid` nor root. Otherwise whoever can create one in a
/// shared folder such as `/tmp` would choose the target.
fn foreign_link(path: &Path, uid: u32) -> Option<PathBuf> {
    let is_foreign = |part: &&Path| {
        let Ok(stat) = rustix::fs::lstat(*part) else { return false };
        FileType::from_raw_mode(stat.st_mode) == FileType::Symlink && stat.st_uid != uid && stat.st_uid != 0
    };
    path.ancestors().find(is_foreign).map(Path::to_owned)
}

/// The right to run a rig; dropping it frees the rig.
#[derive(Debug)]
pub struct RigLock {
    _file: std::fs::File,
}

/// The process that holds the lock `path`, in its own words; `None` if it is free.
pub(crate) fn holder_of(path: &Path) -> Option<String> {
    let file = std::fs::File::open(path).ok()?;
    if flock(&file, FlockOperation::NonBlockingLockShared).is_ok() {
        return None;
    }
    let mut text = Vec::new();
    file.take(MOST_OF_A_HOLDER).read_to_end(&mut text).ok()?;
    // Another program wrote it, so it may be anything; the lock is held all the same.
    Some(String::from_utf8_lossy(&text).chars().filter(|c| !c.is_control()).collect())
}

/// Takes the lock `path` and writes `who` into it; `None` when somebody else holds it.
pub(crate) fn take(path: &Path, who: &str) -> Result<Option<std::fs::File>> {
    let flags = OFlags::RDWR | OFlags::CREATE | OFlags::CLOEXEC;
    let fd = rustix::fs::open(path, flags, Mode::RUSR | Mode::WUSR).map_err(|e| {
        Error::new(ErrorKind::PermissionDenied, format!("{}: cannot be opened", path.display()))
            .with_source(e)
    })?;
    let mut file = std::fs::File::from(fd);
    // A process that checks the lock holds it for an instant, so one refusal proves nothing.
    let taken = (0..LOCK_ATTEMPTS).any(|attempt| {
        if attempt > 0 {
            std::thread::sleep(LOCK_PAUSE);
        }
        flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok()
    });
    if !taken {
        return Ok(None);
    }
    let written = file.set_len(0).and_then(|()| file.rewind()).and_then(|()| file.write_all(who.as_bytes()));
    written.map_err(|e| {
        Error::new(ErrorKind::Other, format!("{}: cannot be written", path.display())).with_source(e)
    })?;
    Ok(Some(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rig_is_held_once_and_its_holder_is_named() {
        let tmp = tempfile::tempdir().unwrap();
        let dir = RuntimeDir::at(tmp.path()).unwrap();
        let rig = RigName::new("mount").unwrap();
        assert_eq!(dir.holder(&rig), None);
        let lock = dir.lock(&rig, "process 42 (rig.toml)").unwrap();
        let e = dir.lock(&rig, "me").unwrap_err();
        assert_eq!(e.kind(), ErrorKind::InUse);
        assert!(e.to_string().contains("process 42 (rig.toml)"), "{e}");
        assert_eq!(dir.running_rigs(), vec![rig.clone()]);
        drop(lock);
        assert!(dir.running_rigs().is_empty());
        dir.lock(&rig, "me").unwrap();
    }

    #[test]
    fn those_who_look_do_not_keep_a_rig_from_starting() {
        let tmp = tempfile::tempdir().unwrap();
        let dir = RuntimeDir::at(tmp.path()).unwrap();
        let rig = RigName::new("mount").unwrap();
        let done = std::sync::atomic::AtomicBool::new(false);
        std::thread::scope(|s| {
            s.spawn(|| {
                while !done.load(std::sync::atomic::Ordering::Relaxed) {
                    dir.running_rigs();
                }
            });
            let taken: Vec<_> = (0..500).map(|_| dir.lock(&rig, "me").map(drop)).collect();
            done.store(true, std::sync::atomic::Ordering::Relaxed);
            assert!(taken.iter().all(Result::is_ok), "{:?}", taken.iter().find(|t| t.is_err()));
        });
    }

    /// As root the link is given to another user; else links of root (which are followed) are all there is.
    #[test]
    fn a_link_of_another_user_is_refused_and_its_target_left_alone() {
        use std::os::unix::fs::{PermissionsExt, lchown, symlink};
        let tmp = tempfile::tempdir().unwrap();
        let target = tmp.path().join("mine");
        std::fs::create_dir(&target).unwrap();
        std::fs::set_permissions(&target, std::fs::Permissions::from_mode(0o755)).unwrap();
        let mode = || std::fs::metadata(&target).unwrap().permissions().mode() & 0o777;
        let link = tmp.path().join("l");
        symlink(&target, &link).unwrap();
        let below = link.join("r");
        assert_eq!(foreign_link(&below, rustix::process::getuid().as_raw()), None, "one's own link");
        let own = rustix::process::getuid();
        assert_eq!(foreign_link(&below, own.as_raw() + 1).is_some(), !own.is_root());
        if rustix::process::getuid().is_root() {
            lchown(&link, Some(4243), Some(4243)).unwrap();
            for path in [&link, &below] {
                let e = RuntimeDir::at(path).unwrap_err();
                assert_eq!(e.kind(), ErrorKind::PermissionDenied);
                assert!(e.to_string().contains("symbolic link of another user"), "{e}");
            }
            assert_eq!((mode(), target.join("r").exists()), (0o755, false));
            lchown(&link, Some(0), Some(0)).unwrap();
        }
        RuntimeDir::at(&link).unwrap();
        assert_eq!(mode(), 0o700);
    }

    #[test]
    fn the_folder_is_private_and_short() {
        let tmp = tempfile::tempdir().unwrap();
        let path = tmp.path().join("r");
        RuntimeDir::at(&path).unwrap();
        assert_eq!(rustix::fs::stat(&path).unwrap().st_mode & 0o777, 0o700);
        let e = RuntimeDir::at(&path.join("x".repeat(60))).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::LimitReached);
    }
}
