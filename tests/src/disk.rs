//! Disks that misbehave: one that stalls, is slow or fails on command, and a small real one.

use depthrig_bus::HostTime;
use depthrig_recorder::fs::{DirEntry, Fs, ReadFile, RealFs, WriteFile};
use std::fs::OpenOptions;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What is wrong with a [`Disk`] now.
#[derive(Debug, Default)]
struct Trouble {
    /// Writes and syncs wait until then.
    stalled_until: Option<HostTime>,
    /// Writes and syncs fail so.
    fails: Option<io::ErrorKind>,
}

/// This computer's disk, with trouble that a test switches on and off; clones share it.
#[derive(Debug, Clone, Default)]
pub struct Disk {
    trouble: Arc<Mutex<Trouble>>,
    /// Bytes per second; 0: as fast as it goes.
    speed: Arc<AtomicU64>,
    written: Arc<AtomicU64>,
}

impl Disk {
    /// From now on nothing is written for so long.
    pub fn stall(&self, length: Duration) {
        self.trouble.lock().unwrap().stalled_until = Some(HostTime::now().plus(length));
    }

    /// From now on it takes so many bytes a second; 0: as many as come.
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

/// Fails the test if it may not do without a small disk. If it may, that is said on stderr, and for tools/test.sh
/// in a line of the file that `DEPTHRIG_TEST_SKIPS` names: cargo keeps to itself what a passing test prints.
fn without_a_small_disk(why: &str) {
    assert!(
        std::env::var_os("DEPTHRIG_REQUIRE_TMPFS").is_none(),
        "a small disk cannot be mounted here, which DEPTHRIG_REQUIRE_TMPFS forbids: {why}"
    );
    eprintln!("SKIPPED: a small disk cannot be mounted here: {why}");
    if let Some(path) = std::env::var_os("DEPTHRIG_TEST_SKIPS") {
        use std::io::Write as _;
        let mut file = OpenOptions::new().create(true).append(true).open(path).unwrap();
        // In one write, so that lines of tests that run at the same time do not mix.
        file.write_all(format!("tmpfs: {why}\n").as_bytes()).unwrap();
    }
}

/// A real file system in memory of a given size, unmounted at the end.
#[derive(Debug)]
pub struct Tmpfs(PathBuf);

impl Tmpfs {
    /// Mounts one on the new folder `dir`; `None`, with the reason on stderr, where this user may not mount.
    ///
    /// # Panics
    /// When it cannot be mounted and `DEPTHRIG_REQUIRE_TMPFS` is set.
    pub fn mount(dir: &Path, bytes: u64) -> Option<Self> {
        std::fs::create_dir_all(dir).unwrap();
        let size = format!("size={bytes},mode=0700");
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", &size, "depthrig-test"]).arg(dir).output();
        let why = match mounted {
            Ok(done) if done.status.success() => return Some(Self(dir.to_owned())),
            Ok(done) => String::from_utf8_lossy(&done.stderr).trim().replace('\n', " "),
            Err(e) => format!("there is no mount command: {e}"),
        };
        without_a_small_disk(&why);
        None
    }

    /// Its folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Makes it read-only; nothing on it may be open for writing.
    pub fn make_read_only(&self) {
        let done = Command::new("mount").args(["-o", "remount,ro"]).arg(&self.0).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }

    /// Fills it up with one file, all but `left` bytes.
    pub fn fill(&self, left: u64) {
        let free = RealFs.available_space(&self.0).unwrap();
        std::fs::write(self.0.join("filler"), vec![0; free.saturating_sub(left) as usize]).unwrap();
    }
}

impl Drop for Tmpfs {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}
