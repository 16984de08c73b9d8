//! A fake `/sys`, `/proc` and `/dev` with the kernel's links, for tests here and in the layers above.

#![allow(clippy::missing_errors_doc, clippy::unwrap_used)] // for tests alone

use super::SysRoot;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

/// A tree under construction.
#[derive(Debug)]
pub struct FakeTree {
    root: SysRoot,
}

/// Number, class, subclass, driver, numbers of its video nodes, of its raw HID nodes.
pub type FakeInterface = (u8, u8, u8, &'static str, Vec<u32>, Vec<u32>);

/// A device to be put into the tree; [`FakeDevice::new`] is a D435 on USB3.
#[derive(Debug, Clone)]
pub struct FakeDevice {
    /// `4-1.2`.
    pub port: String,
    /// The controller's folder below `sys/devices`.
    pub controller: &'static str,
    /// Vendor and product.
    pub id: (u16, u16),
    /// Strings: manufacturer, product, serial; an empty one has no file.
    pub strings: [&'static str; 3],
    /// Mbit/s.
    pub speed: u32,
    /// As the kernel prints it: ` 3.20`.
    pub version: &'static str,
    /// `power/control`.
    pub power: &'static str,
    /// Its interfaces.
    pub interfaces: Vec<FakeInterface>,
}

impl FakeDevice {
    /// A D435 at `port` on its USB3 bus, whose six video nodes begin with number `first_node`.
    pub fn new(port: &str, first_node: u32) -> Self {
        let n = first_node;
        Self {
            port: port.to_owned(),
            controller: "pci0000:00/0000:00:14.0",
            id: (0x8086, 0x0b07),
            strings: ["Intel(R) RealSense(TM) Depth Camera 435 ", "Intel(R) RealSense(TM) 435", ""],
            speed: 5000,
            version: " 3.20",
            power: "on",
            interfaces: vec![
                (0, 0x0e, 1, "uvcvideo", vec![n, n + 1, n + 2, n + 3], vec![]),
                (1, 0x0e, 2, "uvcvideo", vec![], vec![]),
                (2, 0x0e, 2, "uvcvideo", vec![], vec![]),
                (3, 0x0e, 1, "uvcvideo", vec![n + 4, n + 5], vec![]),
                (4, 0x0e, 2, "uvcvideo", vec![], vec![]),
                (5, 0xff, 0, "", vec![], vec![]),
            ],
        }
    }
}

impl FakeTree {
    /// An empty tree in the folder `at`.
    pub fn new(at: &Path) -> Self {
        for dir in ["sys/bus/usb/devices", "sys/class/video4linux", "proc", "dev"] {
            fs::create_dir_all(at.join(dir)).unwrap();
        }
        Self { root: SysRoot::new(at) }
    }

    /// Its root.
    pub const fn root(&self) -> &SysRoot {
        &self.root
    }

    /// Writes one file, with a line end as the kernel does.
    pub fn file(&self, path: impl AsRef<Path>, text: &str) {
        let path = self.root.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, format!("{text}\n")).unwrap();
    }

    /// Attaches a device.
    pub fn plug(&self, d: &FakeDevice) {
        let (bus, ports) = d.port.split_once('-').unwrap();
        let mut dir = PathBuf::from("sys/devices").join(d.controller).join(format!("usb{bus}"));
        let parts: Vec<_> = ports.split('.').collect();
        for n in 1..=parts.len() {
            dir.push(format!("{bus}-{}", parts[..n].join(".")));
        }
        let number = 2 + fs::read_dir(self.root.join("sys/bus/usb/devices")).unwrap().count();
        let files = [
            ("busnum", bus.to_owned()),
            ("devnum", number.to_string()),
            ("idVendor", format!("{:04x}", d.id.0)),
            ("idProduct", format!("{:04x}", d.id.1)),
            ("bcdDevice", "50d1".to_owned()),
            ("bDeviceClass", "ef".to_owned()),
            ("speed", d.speed.to_string()),
            ("version", d.version.to_owned()),
            ("power/control", d.power.to_owned()),
        ];
        for (name, text) in files {
            self.file(dir.join(name), &text);
        }
        for (name, text) in ["manufacturer", "product", "serial"].into_iter().zip(d.strings) {
            if !text.is_empty() {
                self.file(dir.join(name), text);
            }
        }
        self.link("sys/bus/usb/devices", &d.port, &dir);
        self.touch(&PathBuf::from(format!("dev/bus/usb/{:03}/{number:03}", bus.parse::<u32>().unwrap())));
        for (n, class, subclass, driver, nodes, hidraw) in &d.interfaces {
            let name = format!("{}:1.{n}", d.port);
            let at = dir.join(&name);
            self.file(at.join("bInterfaceNumber"), &format!("{n:02x}"));
            self.file(at.join("bInterfaceClass"), &format!("{class:02x}"));
            self.file(at.join("bInterfaceSubClass"), &format!("{subclass:02x}"));
            self.file(at.join("bInterfaceProtocol"), "00");
            self.link("sys/bus/usb/devices", &name, &at);
            if !driver.is_empty() {
                let drivers = PathBuf::from("sys/bus/usb/drivers").join(driver);
                fs::create_dir_all(self.root.join(&drivers)).unwrap();
                self.link(&at, "driver", &drivers);
            }
            for (index, node) in nodes.iter().enumerate() {
                self.video(&at, *node, index, d.strings[1]);
            }
            for node in hidraw {
                let hid = format!("0003:{:04X}:{:04X}.{node:04X}", d.id.0, d.id.1);
                self.file(at.join(hid).join(format!("hidraw/hidraw{node}/dev")), "240:0");
                self.touch(&PathBuf::from(format!("dev/hidraw{node}")));
            }
        }
    }

    /// A node that is on no USB device: `device` is its folder below `sys/devices`, such as `platform/vivid.0`.
    pub fn platform_video(&self, device: &str, number: u32, name: &str) {
        self.video(&PathBuf::from("sys/devices").join(device), number, 0, name);
    }

    /// A process with open files.
    pub fn process(&self, pid: u32, name: &str, files: &[&str]) {
        self.file(format!("proc/{pid}/comm"), name);
        let fd = self.root.join(format!("proc/{pid}/fd"));
        fs::create_dir_all(&fd).unwrap();
        for (n, file) in files.iter().enumerate() {
            symlink(self.root.at(Path::new(file)), fd.join(n.to_string())).unwrap();
        }
    }

    fn video(&self, device: &Path, number: u32, index: usize, name: &str) {
        let dir = device.join(format!("video4linux/video{number}"));
        self.file(dir.join("name"), name);
        self.file(dir.join("index"), &index.to_string());
        self.link("sys/class/video4linux", &format!("video{number}"), &dir);
        self.touch(&PathBuf::from(format!("dev/video{number}")));
    }

    fn touch(&self, path: &Path) {
        let path = self.root.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, []).unwrap();
    }

    /// A relative link `from`/`name` to `to`, as the kernel makes them; both below the root.
    fn link(&self, from: impl AsRef<Path>, name: &str, to: &Path) {
        let from = from.as_ref();
        let up: PathBuf = from.iter().map(|_| "..").collect();
        fs::create_dir_all(self.root.join(from)).unwrap();
        symlink(up.join(to), self.root.join(from).join(name)).unwrap();
    }
}
