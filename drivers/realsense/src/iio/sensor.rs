//! One sensor: what it measures with, switching it on and off, and its measurements.

use super::find::FoundSensor;
use super::scan::{Element, Layout, Scan};
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::SysRoot;
use depthrig_usb::holder::{Holders, holders_of};
use rustix::fs::OFlags;
use std::fs::{File, OpenOptions};
use std::io::Read as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

/// Scans that the kernel keeps for a reader that is late: more than two seconds at 400 Hz.
const LENGTH: usize = 1024;
/// Scans that one read takes.
const CHUNK: usize = 64;

/// Switches a sensor on and off. Every call may take seconds: the kernel waits for the device.
#[derive(Debug)]
pub struct Switch {
    folder: PathBuf,
}

/// An open sensor.
#[derive(Debug)]
pub struct Sensor {
    file: File,
    node: PathBuf,
    layout: Layout,
    bytes: Vec<u8>,
    /// Bytes of a scan that was cut off.
    rest: usize,
}

fn failed(path: &Path, what: &str, e: std::io::Error) -> Error {
    let (kind, cure) = match e.kind() {
        std::io::ErrorKind::PermissionDenied => (
            ErrorKind::PermissionDenied,
            "; `depthrig install --print` shows the udev rule that lets this user do it",
        ),
        std::io::ErrorKind::NotFound => (ErrorKind::Disconnected, "; is the camera plugged in?"),
        // Settings of a buffer that is on are fixed, and it was switched off just before.
        std::io::ErrorKind::ResourceBusy => (
            ErrorKind::Busy,
            "; another program switched the sensor on: end it (realsense-viewer, a ROS node, another depthrig)",
        ),
        _ => (ErrorKind::Io, "; plug the camera in anew"),
    };
    Error::new(kind, format!("{} cannot be {what}: {e}{cure}", path.display())).with_source(e)
}

/// Why a node that is in use cannot be opened: the kernel lets one program read a sensor.
fn in_use(node: &Path, holders: &Holders, e: std::io::Error) -> Error {
    let node = node.display();
    let text = if holders.own && holders.others.is_empty() {
        format!(
            "{node} is still held by this process, which reads it for another stream or has not ended the last one; try again"
        )
    } else {
        format!(
            "{node} is in use: one program at a time can read this sensor, and it is held by {}. End that program \
             (realsense-viewer, a ROS node or another depthrig reads the IMU too), or take the stream imu out of the rig file",
            holders.describe()
        )
    };
    Error::new(ErrorKind::Busy, text).with_source(e)
}

impl Switch {
    /// The switch of `found`, which it leaves as it is.
    pub fn of(found: &FoundSensor) -> Self {
        Self { folder: found.folder.clone() }
    }

    /// Switches the sensor `found` off, so that it can be set, and lets every element of `axes` (`in_accel_x`, …) into
    /// its scans, with their time.
    ///
    /// # Errors
    /// [`ErrorKind::PermissionDenied`] and [`ErrorKind::Busy`] with the cure, [`ErrorKind::Disconnected`],
    /// [`ErrorKind::Io`].
    pub fn prepare(found: &FoundSensor, axes: [&str; 3]) -> Result<Self> {
        let switch = Self::of(found);
        switch.off()?;
        for element in axes.into_iter().chain(["in_timestamp"]) {
            switch.write(&format!("scan_elements/{element}_en"), "1")?;
        }
        switch.write("buffer/length", &LENGTH.to_string())?;
        Ok(switch)
    }

    /// Writes an attribute of the sensor, such as `in_accel_sampling_frequency`.
    ///
    /// # Errors
    /// Those of [`Self::prepare`].
    pub fn write(&self, attribute: &str, value: &str) -> Result<()> {
        let path = self.folder.join(attribute);
        std::fs::write(&path, value).map_err(|e| failed(&path, &format!("set to {value}"), e))
    }

    /// Starts the measurements.
    ///
    /// # Errors
    /// Those of [`Self::prepare`].
    pub fn on(&self) -> Result<()> {
        self.write("buffer/enable", "1")
    }

    /// Ends them.
    ///
    /// # Errors
    /// Those of [`Self::prepare`].
    pub fn off(&self) -> Result<()> {
        self.write("buffer/enable", "0")
    }
}

impl Sensor {
    /// Opens the node of a sensor that measures `axes`. Nobody else can read it as long as it is open.
    ///
    /// # Errors
    /// Those of [`Switch::prepare`], where [`ErrorKind::Busy`] names the program that has it; [`ErrorKind::Protocol`]
    /// when its scans are of a kind that is not known.
    pub fn open(root: &SysRoot, found: &FoundSensor, axes: [&str; 3]) -> Result<Self> {
        let read = |element: &str, what: &str| {
            let path = found.folder.join(format!("scan_elements/{element}_{what}"));
            std::fs::read_to_string(&path).map_err(|e| failed(&path, "read", e))
        };
        let element = |name: &str| -> Result<(u32, Element)> {
            let index = read(name, "index")?;
            let index = index.trim().parse().map_err(|_| {
                Error::new(
                    ErrorKind::Protocol,
                    format!("{}: invalid index \"{}\" of {name}", found.name, index.trim()),
                )
            })?;
            Ok((index, Element::parse(&read(name, "type")?)?))
        };
        let [x, y, z] = axes;
        let layout = Layout::new([element(x)?, element(y)?, element(z)?, element("in_timestamp")?]);
        let flags = OFlags::NONBLOCK.bits() as i32;
        let file = OpenOptions::new().read(true).custom_flags(flags).open(&found.node);
        let file = file.map_err(|e| match e.kind() {
            std::io::ErrorKind::ResourceBusy => in_use(&found.node, &holders_of(root, &found.node), e),
            _ => failed(&found.node, "opened", e),
        })?;
        let bytes = vec![0; CHUNK * layout.bytes()];
        Ok(Self { file, node: found.node.clone(), layout, bytes, rest: 0 })
    }

    /// Bits of an axis that mean something.
    pub const fn bits(&self) -> u32 {
        self.layout.bits()
    }

    /// Hands every measurement that has come to `take`. It does not wait.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`] when the device is gone, [`ErrorKind::Io`].
    pub fn drain(&mut self, mut take: impl FnMut(Scan)) -> Result<()> {
        loop {
            let space = self.bytes.get_mut(self.rest..).unwrap_or_default();
            let count = match self.file.read(space) {
                Ok(0) => return Ok(()),
                Ok(count) => count,
                Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => return Ok(()),
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(e) => {
                    let gone =
                        [rustix::io::Errno::NODEV, rustix::io::Errno::NXIO, rustix::io::Errno::SHUTDOWN];
                    let is_gone = gone.iter().any(|errno| e.raw_os_error() == Some(errno.raw_os_error()));
                    let kind = if is_gone { ErrorKind::Disconnected } else { ErrorKind::Io };
                    let text = format!("{} gives no measurement: {e}", self.node.display());
                    return Err(Error::new(kind, text).with_source(e));
                }
            };
            let end = self.rest + count;
            let whole = end - end % self.layout.bytes();
            for bytes in self.bytes.get(..whole).unwrap_or_default().chunks_exact(self.layout.bytes()) {
                if let Some(scan) = self.layout.read(bytes) {
                    take(scan);
                }
            }
            self.bytes.copy_within(whole..end, 0);
            self.rest = end - whole;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_usb::holder::Holder;
    use rustix::io::Errno;

    fn busy(others: &[(u32, &str)], own: bool) -> Error {
        let others =
            others.iter().map(|(pid, name)| Holder { pid: *pid, name: (*name).to_owned() }).collect();
        let e = std::io::Error::from_raw_os_error(Errno::BUSY.raw_os_error());
        in_use(Path::new("/dev/iio:device0"), &Holders { others, own, hidden: 0 }, e)
    }

    #[test]
    fn a_sensor_that_is_in_use_says_who_reads_it_and_what_to_end() {
        let e = busy(&[(4711, "realsense-viewe")], false);
        assert_eq!(e.kind(), ErrorKind::Busy);
        let text = e.to_string();
        for part in
            ["/dev/iio:device0 is in use", "realsense-viewe (process 4711)", "End that program", "imu"]
        {
            assert!(text.contains(part), "{part}: {text}");
        }
        let own = busy(&[], true).to_string();
        assert!(own.contains("this process") && !own.contains("End that program"), "{own}");
    }

    #[test]
    fn a_setting_that_is_refused_says_what_to_do_about_the_reason() {
        for (errno, kind, cure) in [
            (Errno::BUSY, ErrorKind::Busy, "another program"),
            (Errno::ACCESS, ErrorKind::PermissionDenied, "udev rule"),
            (Errno::NOENT, ErrorKind::Disconnected, "plugged in?"),
            (Errno::IO, ErrorKind::Io, "plug the camera in anew"),
        ] {
            let e = std::io::Error::from_raw_os_error(errno.raw_os_error());
            let e = failed(Path::new("buffer/length"), "set to 1024", e);
            assert_eq!(e.kind(), kind);
            assert!(e.to_string().contains(cure), "{e}");
        }
    }
}
