//! Which sensors there are, by topology.

use depthrig_usb::SysRoot;
use std::path::PathBuf;

/// A sensor of the industrial I/O.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundSensor {
    /// Its driver's name for it: `accel_3d`, `gyro_3d`.
    pub name: String,
    /// Its folder in sysfs.
    pub folder: PathBuf,
    /// `/dev/iio:device0`, below the root that was asked.
    pub node: PathBuf,
}

impl FoundSensor {
    /// The files that have to be written to switch it on.
    pub fn switches(&self) -> [PathBuf; 2] {
        [self.folder.join("buffer/enable"), self.folder.join("buffer/length")]
    }
}

/// The sensors of the USB device at `port`, such as `4-1.2`, by their numbers.
pub fn on_port(root: &SysRoot, port: &str) -> Vec<FoundSensor> {
    let entries = std::fs::read_dir(root.join("sys/bus/iio/devices"));
    let mut found: Vec<(u32, FoundSensor)> = entries
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| {
            let file_name = entry.file_name();
            let file_name = file_name.to_str()?;
            let number = file_name.strip_prefix("iio:device")?.parse().ok()?;
            let folder = entry.path().canonicalize().ok()?;
            let is_here = folder.ancestors().any(|dir| dir.file_name().is_some_and(|name| name == port));
            let name = std::fs::read_to_string(folder.join("name")).ok()?.trim().to_owned();
            let node = root.join("dev").join(file_name);
            is_here.then_some((number, FoundSensor { name, folder, node }))
        })
        .collect();
    found.sort_by_key(|(number, _)| *number);
    found.into_iter().map(|(_, found)| found).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn sensors_belong_to_the_device_that_they_are_below() {
        let dir = tempfile::tempdir().unwrap();
        let devices = dir.path().join("sys/bus/iio/devices");
        std::fs::create_dir_all(&devices).unwrap();
        for (at, (port, name)) in
            [("2-1", "gyro_3d"), ("2-10", "accel_3d"), ("2-1", "accel_3d")].into_iter().enumerate()
        {
            let folder =
                dir.path().join(format!("sys/devices/pci/{port}/{port}:1.5/HID-{at}/iio:device{at}"));
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("name"), format!("{name}\n")).unwrap();
            symlink(&folder, devices.join(format!("iio:device{at}"))).unwrap();
        }
        let root = SysRoot::new(dir.path());
        let names = |port: &str| on_port(&root, port).into_iter().map(|f| f.name).collect::<Vec<_>>();
        assert_eq!(names("2-1"), ["gyro_3d", "accel_3d"]);
        assert_eq!(names("2-10"), ["accel_3d"]);
        assert_eq!(on_port(&root, "2-1")[1].node, dir.path().join("dev/iio:device2"));
        assert!(on_port(&SysRoot::new(dir.path().join("nothing")), "2-1").is_empty());
    }
}
