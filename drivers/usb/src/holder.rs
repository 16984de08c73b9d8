//! Who holds a node open, from `/proc/*/fd`.
//!
//! The files of another user's process can be listed by root alone, so "nobody" is said only when every process could
//! be asked.

use super::SysRoot;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::Path;

/// A process that has a node open.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Holder {
    /// Its process id.
    pub pid: u32,
    /// Its name as the kernel keeps it (at most 15 bytes).
    pub name: String,
}

/// The processes that have a node open.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Holders {
    /// Those that were found, by process id; this process is not among them.
    pub others: Vec<Holder>,
    /// This process has it open itself.
    pub own: bool,
    /// How many processes of other users could not be asked.
    pub hidden: usize,
}

impl Holders {
    /// `obs (process 4711)`, or what is known when nobody was found: for messages of the form "it is held by …".
    pub fn describe(&self) -> String {
        match (self.others.as_slice(), self.own, self.hidden) {
            ([], true, _) => "this process itself".to_owned(),
            ([], false, 0) => "no process (it may have let go just now)".to_owned(),
            ([], false, n) => {
                format!(
                    "a process of another user (as root its name can be seen; {n} processes could not be asked)"
                )
            }
            (some, ..) => {
                let names: Vec<_> = some.iter().map(|h| format!("{} (process {})", h.name, h.pid)).collect();
                names.join(", ")
            }
        }
    }
}

/// The first process other than this one that has `node` open, as far as this user may see.
pub fn holder_of(root: &SysRoot, node: &Path) -> Option<Holder> {
    holders_of(root, node).others.into_iter().next()
}

/// Every process that has `node` open, as far as this user may see.
pub fn holders_of(root: &SysRoot, node: &Path) -> Holders {
    let mut found = Holders::default();
    let Ok(processes) = fs::read_dir(root.join("proc")) else { return found };
    let device = fs::metadata(node).ok().filter(|m| m.file_type().is_char_device()).map(|m| m.rdev());
    for process in processes.flatten() {
        let Some(pid) = process.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else {
            continue;
        };
        let files = match fs::read_dir(process.path().join("fd")) {
            Ok(files) => files,
            // A process that has just ended hides nothing.
            Err(e) => {
                found.hidden += usize::from(e.kind() == std::io::ErrorKind::PermissionDenied);
                continue;
            }
        };
        if !files.flatten().any(|file| is_node(&file.path(), node, device)) {
            continue;
        }
        if pid == std::process::id() {
            found.own = true;
        } else {
            let name = super::root::read_text(&process.path().join("comm")).unwrap_or_default();
            found.others.push(Holder { pid, name });
        }
    }
    found.others.sort();
    found
}

/// Whether an open file is `node`: by its path, or by its device number when it was opened under another name.
fn is_node(file: &Path, node: &Path, device: Option<u64>) -> bool {
    let Ok(target) = fs::read_link(file) else { return false };
    if target == node {
        return true;
    }
    // Only what lies in a /dev is looked at further: to ask for a file on a dead network disk may never return.
    target.iter().any(|part| part == OsStr::new("dev"))
        && device.is_some_and(|wanted| {
            fs::metadata(file).is_ok_and(|m| m.file_type().is_char_device() && m.rdev() == wanted)
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fake::FakeTree;

    #[test]
    fn the_process_that_has_the_node_open_is_named() {
        let home = tempfile::tempdir().unwrap();
        let tree = FakeTree::new(home.path());
        tree.process(4711, "obs", &["/dev/null", "/dev/video2"]);
        tree.process(80, "cheese", &["/dev/video2"]);
        tree.process(81, "bystander", &["/dev/video20"]);
        let holders = holders_of(tree.root(), &tree.root().join("dev/video2"));
        assert_eq!(holders.describe(), "cheese (process 80), obs (process 4711)");
        assert_eq!(holder_of(tree.root(), &tree.root().join("dev/video2")).unwrap().pid, 80);
        assert_eq!(holder_of(tree.root(), &tree.root().join("dev/video3")), None);
    }

    #[test]
    fn nobody_is_said_only_when_everybody_could_be_asked() {
        let nobody = Holders::default();
        assert!(nobody.describe().starts_with("no process"), "{}", nobody.describe());
        let hidden = Holders { hidden: 3, ..Holders::default() };
        assert!(hidden.describe().contains("another user") && hidden.describe().contains("3 processes"));
        let own = Holders { own: true, hidden: 3, ..Holders::default() };
        assert_eq!(own.describe(), "this process itself");
    }

    #[test]
    fn a_node_that_was_opened_under_another_name_is_the_same_node() {
        // /dev/null and a link to it, held by a child whose table is the real one.
        let home = tempfile::tempdir().unwrap();
        let link = home.path().join("dev-null");
        std::os::unix::fs::symlink("/dev/zero", &link).unwrap();
        let stdin = fs::File::open(&link).unwrap();
        let mut child = std::process::Command::new("sleep").arg("60").stdin(stdin).spawn().unwrap();
        // The child is this program until it has become `sleep`.
        let named = |pid: u32| {
            let deadline = depthrig_bus::HostTime::now().plus(core::time::Duration::from_secs(20));
            loop {
                let holders = holders_of(&SysRoot::default(), Path::new("/dev/zero"));
                let found = holders.others.into_iter().find(|h| h.pid == pid && h.name == "sleep");
                if found.is_some() || depthrig_bus::HostTime::now() > deadline {
                    return found;
                }
            }
        };
        let found = named(child.id());
        child.kill().unwrap();
        child.wait().unwrap();
        assert_eq!(found.map(|h| h.name).as_deref(), Some("sleep"));
    }

    #[test]
    fn the_own_hold_is_recognised() {
        let file = fs::File::open("/dev/urandom").unwrap();
        assert!(holders_of(&SysRoot::default(), Path::new("/dev/urandom")).own);
        drop(file);
    }
}
