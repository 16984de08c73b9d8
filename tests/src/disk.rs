//! Disks that misbehave: one that stalls, is slow or fails on command, and a small real one.
#![allow(unsafe_code)] // mount(2) and umount2(2)

use depthrig_bus::HostTime;
use depthrig_recorder::fs::{DirEntry, Fs, ReadFile, RealFs, WriteFile};
use std::ffi::CString;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Faults that a [`Disk`] has now.
#[derive(Debug, Default)]
struct Trouble {
    /// Writes and syncs wait until this time.
    stalled_until: Option<HostTime>,
    /// Writes and syncs fail with this error.
    fails: Option<io::ErrorKind>,
}

/// This computer's disk with faults that a test switches on and off; clones share them.
#[derive(Debug, Clone, Default)]
pub struct Disk {
    trouble: Arc<Mutex<Trouble>>,
    /// Bytes per second; 0: as fast as it goes.
    speed: Arc<AtomicU64>,
    written: Arc<AtomicU64>,
}

impl Disk {
    /// Stalls all writes for `length` from now on.
    pub fn stall(&self, length: Duration) {
        self.trouble.lock().unwrap().stalled_until = Some(HostTime::now().plus(length));
    }

    /// Limits writing to `bytes_per_s` from now on; 0 removes the limit.
    pub fn slow_down(&self, bytes_per_s: u64) {
        self.speed.store(bytes_per_s, Ordering::SeqCst);
    }

    /// From now on every write fails so.
    pub fn fail(&self, kind: io::ErrorKind) {
        self.trouble.lock().unwrap().fails = Some(kind);
    }

    /// Bytes written so far.
    pub fn written(&self) -> u64 {
        self.written.load(Ordering::SeqCst)
    }

    /// Suffers the trouble of now with an operation on `bytes` bytes.
    fn suffer(&self, bytes: usize) -> io::Result<()> {
        loop {
            let trouble = self.trouble.lock().unwrap();
            if let Some(kind) = trouble.fails {
                return Err(kind.into());
            }
            let left = trouble.stalled_until.map_or(Duration::ZERO, HostTime::from_now);
            drop(trouble);
            if left.is_zero() {
                break;
            }
            std::thread::sleep(left);
        }
        let speed = self.speed.load(Ordering::SeqCst);
        if let Some(ns) = (bytes as u64 * 1_000_000_000).checked_div(speed) {
            std::thread::sleep(Duration::from_nanos(ns));
        }
        Ok(())
    }
}

struct DiskFile {
    disk: Disk,
    file: Box<dyn WriteFile>,
}

impl WriteFile for DiskFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.disk.suffer(bytes.len())?;
        let n = self.file.write(bytes)?;
        self.disk.written.fetch_add(n as u64, Ordering::SeqCst);
        Ok(n)
    }

    fn truncate(&mut self, len: u64) -> io::Result<()> {
        self.disk.suffer(0)?;
        self.file.truncate(len)
    }

    fn sync_data(&mut self) -> io::Result<()> {
        self.disk.suffer(0)?;
        self.file.sync_data()
    }

    fn sync_all(&mut self) -> io::Result<()> {
        self.disk.suffer(0)?;
        self.file.sync_all()
    }
}

impl Fs for Disk {
    fn create_dir_all(&self, dir: &Path) -> io::Result<()> {
        self.suffer(0)?;
        RealFs.create_dir_all(dir)
    }

    fn create_new(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        self.suffer(0)?;
        Ok(Box::new(DiskFile { disk: self.clone(), file: RealFs.create_new(path)? }))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        RealFs.open(path)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.suffer(0)?;
        RealFs.rename(from, to)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.suffer(0)?;
        RealFs.remove_file(path)
    }

    fn remove_dir(&self, dir: &Path) -> io::Result<()> {
        self.suffer(0)?;
        RealFs.remove_dir(dir)
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        self.suffer(0)?;
        RealFs.sync_dir(dir)
    }

    fn read_dir(&self, dir: &Path) -> io::Result<Vec<DirEntry>> {
        RealFs.read_dir(dir)
    }

    fn available_space(&self, dir: &Path) -> io::Result<u64> {
        RealFs.available_space(dir)
    }

    fn lock(&self, dir: &Path) -> io::Result<Box<dyn Send + Sync>> {
        RealFs.lock(dir)
    }
}

/// Fails the test if it may not do without a small disk; else prints the line by which tests/runner/rust.py counts it as
/// skipped.
///
/// # Panics
/// When `DEPTHRIG_REQUIRE_TMPFS` is set.
pub fn without_a_small_disk(why: &str) {
    assert!(
        std::env::var_os("DEPTHRIG_REQUIRE_TMPFS").is_none(),
        "a small disk cannot be mounted here, which DEPTHRIG_REQUIRE_TMPFS forbids: {why}"
    );
    println!("skipped: a small disk cannot be mounted here: {why}");
}

/// mount(2) of a tmpfs: the command of that name works for root alone, whatever rights its caller has.
fn mount_tmpfs(dir: &Path, flags: libc::c_ulong, options: &str) -> io::Result<()> {
    let dir = CString::new(dir.as_os_str().as_bytes())?;
    let options = CString::new(options)?;
    // SAFETY: every pointer is to a C string that lives until the call returns.
    let status = unsafe {
        libc::mount(
            c"depthrig-test".as_ptr(),
            dir.as_ptr(),
            c"tmpfs".as_ptr(),
            flags,
            options.as_ptr().cast(),
        )
    };
    if status == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// A real file system in memory of a given size, unmounted at the end.
#[derive(Debug)]
pub struct Tmpfs(PathBuf);

impl Tmpfs {
    /// Mounts one on the new folder `dir`; `None`, with the reason on stdout, where this user may not mount.
    ///
    /// # Panics
    /// When it cannot be mounted and `DEPTHRIG_REQUIRE_TMPFS` is set.
    pub fn mount(dir: &Path, bytes: u64) -> Option<Self> {
        std::fs::create_dir_all(dir).unwrap();
        match mount_tmpfs(dir, 0, &format!("size={bytes},mode=0700")) {
            Ok(()) => Some(Self(dir.to_owned())),
            Err(why) => {
                without_a_small_disk(&why.to_string());
                None
            }
        }
    }

    /// Its folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Makes it read-only; nothing on it may be open for writing.
    pub fn make_read_only(&self) {
        mount_tmpfs(&self.0, libc::MS_REMOUNT | libc::MS_RDONLY, "").unwrap();
    }

    /// Fills it up with one file, all but `left` bytes.
    pub fn fill(&self, left: u64) {
        let free = RealFs.available_space(&self.0).unwrap();
        // Another writer may take the remaining space.
        match std::fs::write(self.0.join("filler"), vec![0; free.saturating_sub(left) as usize]) {
            Err(e) if e.kind() == io::ErrorKind::StorageFull => {}
            written => written.unwrap(),
        }
    }
}

impl Drop for Tmpfs {
    fn drop(&mut self) {
        if let Ok(dir) = CString::new(self.0.as_os_str().as_bytes()) {
            // SAFETY: the pointer is to a C string that lives until the call returns.
            unsafe { libc::umount2(dir.as_ptr(), libc::MNT_DETACH) };
        }
    }
}
