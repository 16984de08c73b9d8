//! A rig whose process gets another umask goes on. The umask is the process's, so this is the only test in its file.
#![allow(missing_docs, unsafe_code, clippy::unwrap_used, clippy::expect_used)]

use depthrig_tests::{Home, RigText, all_stream, wait_until};

fn now() -> u32 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let text = status.lines().find_map(|l| l.strip_prefix("Umask:")).unwrap();
    u32::from_str_radix(text.trim(), 8).unwrap()
}

/// Whatever changed it: with 0177 only root can enter new folders, and the next recording would be refused.
#[test]
fn a_umask_that_keeps_the_owner_out_is_mended_while_the_rig_runs() {
    let home = Home::default();
    let before = now();
    let rig = home.start(RigText::default().camera("cam", "").text()).unwrap();
    wait_until(&rig, "frames", all_stream);
    for _ in 0..2 {
        // SAFETY: it takes any number and cannot fail.
        unsafe { libc::umask(0o177) };
        wait_until(&rig, "the umask as it was", |_| now() == before);
    }
    rig.stop();
}
