//! Threads that make listeners, and folders, at once. The umask is the process's, so this is the only test in its file.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, RigName, RuntimeDir, StreamId, umask};
use std::os::unix::fs::PermissionsExt;
use std::sync::atomic::{AtomicBool, Ordering};

const THREADS: usize = 8;
const ROUNDS: usize = 20;

fn now() -> u32 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let text = status.lines().find_map(|l| l.strip_prefix("Umask:")).unwrap();
    u32::from_str_radix(text.trim(), 8).unwrap()
}

#[test]
fn threads_that_subscribe_leave_umask_and_folders_alone() {
    let tmp = tempfile::tempdir().unwrap();
    let bus = Bus::open(&RuntimeDir::at(&tmp.path().join("r")).unwrap(), &RigName::new("test").unwrap());
    let bus = bus.unwrap();
    let before = now();
    let ids: Vec<_> = (0..THREADS).map(|i| StreamId::new("cam", &format!("s{i}")).unwrap()).collect();
    let publishers: Vec<_> = ids.iter().map(|id| bus.publisher(id, 64, 16).unwrap()).collect();
    let over = AtomicBool::new(false);
    let folders = std::thread::scope(|scope| {
        let subscribing: Vec<_> = ids
            .iter()
            .map(|id| scope.spawn(|| (0..ROUNDS).for_each(|_| drop(bus.subscriber(id).unwrap()))))
            .collect();
        let making = scope.spawn(|| {
            let mut modes = Vec::new();
            while !over.load(Ordering::Relaxed) {
                let folder = tmp.path().join(modes.len().to_string());
                umask::create_dir_all(&folder).unwrap();
                modes.push(std::fs::metadata(&folder).unwrap().permissions().mode() & 0o777);
            }
            modes
        });
        let ended: Vec<_> = subscribing.into_iter().map(std::thread::ScopedJoinHandle::join).collect();
        over.store(true, Ordering::Relaxed);
        for thread in ended {
            thread.unwrap();
        }
        making.join().unwrap()
    });
    drop(publishers);
    assert_eq!(now(), before, "the umask of the process is another");
    let wrong = folders.iter().filter(|mode| **mode != 0o777 & !before).count();
    assert_eq!(wrong, 0, "of {} folders so many have another mode", folders.len());

    // Whoever else changes it, what keeps the owner out is taken back.
    rustix::process::umask(rustix::fs::Mode::from_bits_truncate(0o177));
    umask::check();
    assert_eq!(now(), before);
}
