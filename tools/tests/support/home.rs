//! A home for the binary under test: its own runtime folder, images for `files` cameras, and its output.
#![allow(dead_code)] // each test binary uses a part of it

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;
use tempfile::TempDir;

/// Liveness bound: far longer than anything takes on a loaded machine.
const POLLS: u32 = 600;
const POLL: Duration = Duration::from_millis(100);

/// The binary.
pub fn depthrig() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_depthrig"));
    command.env_remove("DEPTHRIG_RUNTIME_DIR").env("NO_COLOR", "1");
    command
}

/// Output and exit code of a run.
pub struct Ran {
    pub code: i32,
    pub out: String,
    pub err: String,
}

impl Ran {
    pub fn of(output: &Output) -> Self {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Self {
            code: output.status.code().unwrap_or(-1),
            out: text(&output.stdout),
            err: text(&output.stderr),
        }
    }

    /// The output of a run that must have ended well or with 3: on a busy machine a camera loses a frame now and then, and
    /// what lacks one says so.
    #[track_caller]
    pub fn done(self) -> String {
        assert!(matches!(self.code, 0 | 3), "exit code {}\n{}\n{}", self.code, self.out, self.err);
        self.out
    }

    /// The output of a run that must have gone well.
    #[track_caller]
    pub fn good(self) -> String {
        assert_eq!(self.code, 0, "exit code {}\n{}\n{}", self.code, self.out, self.err);
        self.out
    }
}

/// A folder of one test.
pub struct Home {
    folder: TempDir,
}

impl Home {
    pub fn new() -> Self {
        // Short: sockets live below it.
        Self { folder: tempfile::Builder::new().prefix("dr").tempdir_in("/tmp").unwrap() }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = depthrig();
        command.arg("--runtime-dir").arg(self.path().join("run")).args(args);
        command
    }

    pub fn run(&self, args: &[&str]) -> Ran {
        Ran::of(&self.command(args).stdin(Stdio::null()).output().unwrap())
    }

    pub fn start(&self, args: &[&str]) -> Running {
        let child = self
            .command(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        Running(Some(child))
    }

    pub fn write(&self, name: &str, text: &str) -> String {
        let path = self.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    }

    /// Images of 64x48 for a `files` camera; no two are alike.
    pub fn images(&self, count: u32) {
        for folder in ["color", "depth"] {
            std::fs::create_dir_all(self.path().join(folder)).unwrap();
        }
        for i in 0..count {
            let color =
                image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([x as u8 * 3, y as u8 * 5, i as u8 * 20]));
            color.save(self.path().join(format!("color/{i:03}.png"))).unwrap();
            depth(i).save(self.path().join(format!("depth/{i:03}.png"))).unwrap();
        }
    }

    /// Whether the 16-bit PNG `file` is one of the depth images.
    pub fn is_a_source(&self, file: &Path) -> bool {
        let read = |path: &Path| image::open(path).unwrap().into_luma16();
        let tapped = read(file);
        std::fs::read_dir(self.path().join("depth")).unwrap().any(|e| read(&e.unwrap().path()) == tapped)
    }

    /// A rig with one camera `desk` that plays the images.
    pub fn rig_file(&self, rig: &str) -> String {
        let manifest = include_str!("manifest.toml");
        self.write("images.toml", manifest);
        let text = format!(
            "rig = \"{rig}\"\n[recording]\nallow = [\"data\"]\nreserve_mb = 16\n\n[[camera]]\nname = \"desk\"\nbackend = \"files\"\nmanifest = \"images.toml\"\n"
        );
        self.write("rig.toml", &text)
    }

    /// Waits until the rig answers and each of its cameras streams; a daemon answers before they are open.
    #[track_caller]
    pub fn wait_for_rig(&self, rig: &str) {
        let streams = || {
            let said = self.run(&["status", "--rig", rig, "--json"]);
            let status: serde_json::Value = serde_json::from_str(&said.out).unwrap_or_default();
            let cameras = status["cameras"].as_array().map_or(&[][..], Vec::as_slice);
            !cameras.is_empty() && cameras.iter().all(|camera| camera["state"] == "streaming")
        };
        wait(streams, "the rig does not stream");
    }

    /// Waits until the recording in progress has so many sets.
    #[track_caller]
    pub fn wait_for_sets(&self, sets: u64) {
        let enough = || {
            let said = self.run(&["record", "status", "--json"]);
            let status: serde_json::Value = serde_json::from_str(&said.out).unwrap_or_default();
            status["sets"].as_u64().is_some_and(|n| n >= sets)
        };
        wait(enough, "the recording gets no sets");
    }
}

fn depth(i: u32) -> image::ImageBuffer<image::Luma<u16>, Vec<u16>> {
    image::ImageBuffer::from_fn(64, 48, |x, y| image::Luma([(400 + 100 * i + 7 * x + y) as u16]))
}

/// Waits until `done`.
#[track_caller]
pub fn wait(mut done: impl FnMut() -> bool, what: &str) {
    for _ in 0..POLLS {
        if done() {
            return;
        }
        std::thread::sleep(POLL);
    }
    panic!("{what}");
}

/// A process that runs until it is stopped. Dropping it kills it.
pub struct Running(Option<Child>);

impl Running {
    pub fn id(&self) -> u32 {
        self.0.as_ref().unwrap().id()
    }

    /// Ctrl-C.
    pub fn interrupt(self) -> Ran {
        self.signal("INT")
    }

    /// Sends a signal and leaves it running.
    pub fn send(&self, name: &str) {
        let sent = Command::new("kill").args([&format!("-{name}"), &self.id().to_string()]).status().unwrap();
        assert!(sent.success());
    }

    /// Waits for its first line.
    pub fn wait_for_line(&mut self) {
        use std::io::Read;
        let out = self.0.as_mut().unwrap().stdout.as_mut().unwrap();
        let mut byte = [0];
        while byte != *b"\n" {
            assert_eq!(out.read(&mut byte).unwrap(), 1, "it ended");
        }
    }

    /// Waits for its end, and kills it after a timeout.
    pub fn wait_for_end(mut self) -> Ran {
        let child = self.0.as_mut().unwrap();
        wait(|| child.try_wait().unwrap().is_some(), "it does not end");
        Ran::of(&self.0.take().unwrap().wait_with_output().unwrap())
    }

    pub fn signal(mut self, name: &str) -> Ran {
        let child = self.0.take().unwrap();
        let sent =
            Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
        assert!(sent.success());
        Ran::of(&child.wait_with_output().unwrap())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(mut child) = self.0.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
