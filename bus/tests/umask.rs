//! Threads that make listeners, and folders, at once. The umask is the process's, so no other test of this file may touch it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, unsafe_code)]

use depthrig_bus::{Bus, RigName, RuntimeDir, StreamId, umask};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::process::Command;
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

    // Whoever changes it, bits that keep the owner out are removed.
    rustix::process::umask(rustix::fs::Mode::from_bits_truncate(0o177));
    umask::check();
    assert_eq!(now(), before);
}

/// Containers forbid `unshare` (Docker does by default), and then no thread can have a umask of its own.
#[test]
fn where_unshare_is_refused_umask_and_folders_stay_as_well() {
    let mut again = Command::new(std::env::current_exe().unwrap());
    again.args(["--exact", "threads_that_subscribe_leave_umask_and_folders_alone"]);
    // SAFETY: between fork and exec it makes system calls alone, and allocates nothing.
    unsafe { again.pre_exec(refuse_unshare) };
    let done = again.output().unwrap();
    let said = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success() && said.contains("1 passed"), "{said}");
}

/// Makes the kernel answer `unshare` with EPERM from now on.
fn refuse_unshare() -> std::io::Result<()> {
    const fn instruction(code: u32, if_not: u8, k: u32) -> libc::sock_filter {
        libc::sock_filter { code: code as u16, jt: 0, jf: if_not, k }
    }
    let mut filter = [
        instruction(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0), // the number of the call
        instruction(libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K, 1, libc::SYS_unshare as u32),
        instruction(libc::BPF_RET | libc::BPF_K, 0, libc::SECCOMP_RET_ERRNO | libc::EPERM as u32),
        instruction(libc::BPF_RET | libc::BPF_K, 0, libc::SECCOMP_RET_ALLOW),
    ];
    let program = libc::sock_fprog { len: 4, filter: filter.as_mut_ptr() };
    // SAFETY: the kernel copies the program, which lives until the calls return; it takes no rights but this one away.
    let refused = unsafe {
        libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
            && libc::prctl(libc::PR_SET_SECCOMP, libc::SECCOMP_MODE_FILTER, &raw const program) == 0
            && libc::unshare(libc::CLONE_FS) == -1
    };
    if refused { Ok(()) } else { Err(std::io::Error::last_os_error()) }
}
