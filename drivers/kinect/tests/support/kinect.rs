//! A fake libk4a that was loaded from a file of its own, with the means to command it.
#![allow(unsafe_code, dead_code)] // foreign functions; each test file uses some of them

use depthrig_bus::{DropCounts, DropReason, HostTime};
use depthrig_kinect::live::{LiveConfig, Places};
use depthrig_sim::conformance::{Cannot, Rig, Sent, Trouble};
use libloading::Library;
use std::ffi::{CString, c_char};
use std::path::PathBuf;
use std::time::Duration;

/// The library that cargo built beside this test.
fn built() -> PathBuf {
    let exe = std::env::current_exe().unwrap();
    let folders = exe.ancestors().skip(1).take(2);
    let found = folders.map(|f| f.join("libfake_k4a.so")).find(|p| p.is_file());
    found.expect("libfake_k4a.so lies beside the tests: depthrig-fake-k4a is built with them")
}

/// A copy of the library, whose cameras nobody else has.
pub struct Fake {
    home: tempfile::TempDir,
    library: Library,
}

#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
pub struct Ledger {
    pub captured: u64,
    pub good: u64,
    pub half: u64,
    pub wrong_size: u64,
    pub damaged: u64,
    pub repeated: u64,
    pub lost: u64,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[repr(C)]
pub struct Census {
    pub cameras: u64,
    pub captures: u64,
    pub images: u64,
    pub all_captures: u64,
    pub all_images: u64,
    pub misuse: u64,
}

impl Fake {
    /// A library with one camera for each of `serials`, and a depth engine beside it.
    pub fn new(serials: &[&str]) -> Self {
        let fake = Self::without_engine(serials);
        std::fs::copy(built(), fake.home.path().join("libdepthengine.so.2.0")).unwrap();
        fake
    }

    /// The same without a depth engine.
    pub fn without_engine(serials: &[&str]) -> Self {
        let home = tempfile::tempdir().unwrap();
        let file = home.path().join("libk4a.so.1.4");
        // A copy and not a link: the loader takes one file for one library.
        std::fs::copy(built(), &file).unwrap();
        // SAFETY: the library is the fake one, whose loading runs nothing.
        let library = unsafe { Library::new(file.canonicalize().unwrap()) }.unwrap();
        let fake = Self { home, library };
        for serial in serials {
            fake.command(serial, "add", 0);
        }
        fake
    }

    /// Where it is.
    pub fn places(&self) -> Places {
        Places { library: Some(self.home.path().to_owned()), engine: None }
    }

    /// The folder that it is in.
    pub fn folder(&self) -> PathBuf {
        self.home.path().to_owned()
    }

    /// The configuration of a camera of it.
    pub fn config(&self) -> LiveConfig {
        LiveConfig { places: self.places(), ..LiveConfig::default() }
    }

    /// See `fake_k4a_command`.
    pub fn command(&self, serial: &str, what: &str, n: u64) {
        type Command = unsafe extern "C" fn(*const c_char, *const c_char, u64) -> u32;
        let serial = CString::new(serial).unwrap();
        let text = CString::new(what).unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        let done = unsafe {
            self.library.get::<Command>(b"fake_k4a_command\0").unwrap()(serial.as_ptr(), text.as_ptr(), n)
        };
        assert_eq!(done, 0, "{what}");
    }

    /// Has the camera return `text` as its calibration.
    pub fn calibration(&self, serial: &str, text: &[u8]) {
        type Set = unsafe extern "C" fn(*const c_char, *const u8, usize) -> u32;
        let serial = CString::new(serial).unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        let done = unsafe {
            self.library.get::<Set>(b"fake_k4a_calibration\0").unwrap()(
                serial.as_ptr(),
                text.as_ptr(),
                text.len(),
            )
        };
        assert_eq!(done, 0);
    }

    /// The camera's record of the images of `stream`: 0 colour, 1 depth, 2 infrared.
    pub fn ledger(&self, serial: &str, stream: usize) -> Ledger {
        type Ask = unsafe extern "C" fn(*const c_char, usize, *mut Ledger) -> u32;
        let serial = CString::new(serial).unwrap();
        let mut ledger = Ledger::default();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        let ask = unsafe { self.library.get::<Ask>(b"fake_k4a_ledger\0") }.unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        assert_eq!(unsafe { ask(serial.as_ptr(), stream, &raw mut ledger) }, 0);
        ledger
    }

    /// Handles handed out and returned.
    pub fn census(&self) -> Census {
        let mut census = Census::default();
        let ask =
            // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
            unsafe { self.library.get::<unsafe extern "C" fn(*mut Census)>(b"fake_k4a_census\0") }.unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        unsafe { ask(&raw mut census) };
        census
    }

    /// The value of a colour control; -1 when it is automatic, -2 when nobody set it.
    pub fn control(&self, serial: &str, command: u32) -> i32 {
        type Ask = unsafe extern "C" fn(*const c_char, u32) -> i32;
        let serial = CString::new(serial).unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        unsafe { self.library.get::<Ask>(b"fake_k4a_control\0").unwrap()(serial.as_ptr(), command) }
    }

    /// The commands of the colour controls in the order in which they were set.
    pub fn set(&self, serial: &str) -> Vec<i32> {
        type Ask = unsafe extern "C" fn(*const c_char, usize) -> i32;
        let serial = CString::new(serial).unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        let ask = unsafe { self.library.get::<Ask>(b"fake_k4a_set\0") }.unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        (0..4096).map(|i| unsafe { ask(serial.as_ptr(), i) }).take_while(|c| *c >= 0).collect()
    }

    /// The configuration that the camera streams with.
    pub fn configuration(&self, serial: &str) -> Option<fake_k4a::abi::Configuration> {
        type Ask = unsafe extern "C" fn(*const c_char, *mut fake_k4a::abi::Configuration) -> u32;
        let serial = CString::new(serial).unwrap();
        let mut to = core::mem::MaybeUninit::uninit();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        let ask = unsafe { self.library.get::<Ask>(b"fake_k4a_configuration\0") }.unwrap();
        // SAFETY: the same; it is written to when the result is 0.
        unsafe { (ask(serial.as_ptr(), to.as_mut_ptr()) == 0).then(|| to.assume_init()) }
    }

    /// True mid-exposure of the newest image that had arrived at `at`.
    pub fn exposed(&self, serial: &str, at: HostTime) -> Option<HostTime> {
        type Ask = unsafe extern "C" fn(*const c_char, i64) -> i64;
        let serial = CString::new(serial).unwrap();
        // SAFETY: the type is the one that the fake library declares; what is pointed to outlives the call.
        let ns = unsafe { self.library.get::<Ask>(b"fake_k4a_exposed\0").unwrap()(serial.as_ptr(), at.ns()) };
        (ns != 0).then(|| HostTime::from_ns(ns))
    }
}

/// Fault injection and ground truth for the conformance suite. `streams` are the numbers of what is started, in its
/// order.
pub struct TestRig {
    pub fake: Fake,
    pub serial: &'static str,
    pub streams: Vec<usize>,
    pub is_genuine: fn(usize, &[u8]) -> bool,
}

impl Rig for TestRig {
    fn cause(&self, trouble: Trouble) -> Result<(), Cannot> {
        let ns = |d: Duration| d.as_nanos() as u64;
        let (what, n) = match trouble {
            Trouble::Unplug(d) => ("unplug", ns(d)),
            Trouble::Stall(d) => ("stall", ns(d)),
            Trouble::Hang(d) => ("hang", ns(d)),
            Trouble::HalfFrame(n) => ("half", n.into()),
            Trouble::WrongSize(n) => ("wrong_size", n.into()),
            Trouble::Damaged(n) => ("damaged", n.into()),
            Trouble::Repeated(n) => ("repeated", n.into()),
            Trouble::Skip(n) => ("skip", n.into()),
            Trouble::TimeBackwards(d) => ("clock_back", ns(d)),
            Trouble::ClockReset => ("clock_reset", 0),
            Trouble::Busy(d) => ("busy", ns(d)),
        };
        self.fake.command(self.serial, what, n);
        Ok(())
    }

    fn sent(&self, stream: usize) -> Option<Sent> {
        let l = self.fake.ledger(self.serial, *self.streams.get(stream)?);
        let mut drops = DropCounts::default();
        for (reason, n) in [
            (DropReason::Incomplete, l.half),
            (DropReason::WrongSize, l.wrong_size),
            (DropReason::DeviceError, l.damaged),
            (DropReason::OutOfOrder, l.repeated),
            (DropReason::DeviceGap, l.lost),
        ] {
            drops.add(reason, n);
        }
        Some(Sent { captured: l.captured, good: l.good, drops })
    }

    fn true_capture(&self, _: usize, arrival: HostTime) -> Option<(HostTime, u64)> {
        // A map cannot know the constant latency, which is 20 ms here.
        Some((self.fake.exposed(self.serial, arrival)?, 21_000_000))
    }

    fn is_genuine(&self, stream: usize, pixels: &[u8]) -> Option<bool> {
        Some((self.is_genuine)(self.streams[stream], pixels))
    }
}
