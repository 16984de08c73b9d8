//! `depthrig install` from the command line, into a temporary root.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use std::process::Command;
use support::Home;

#[test]
fn what_is_shown_is_what_is_written_and_a_change_by_hand_survives() {
    let home = Home::new();
    let root = home.path().join("root").to_str().unwrap().to_owned();
    let options = ["--user", "robot", "--data", "/data/rig", "--root", &root];
    let run = |action: &str, more: &[&str]| home.run(&[&["install", action], &options[..], more].concat());
    let shown = run("--print", &[]).good();
    assert!(shown.contains("not installed") && shown.contains("udevadm control --reload"), "{shown}");
    assert!(!home.path().join("root").exists(), "--print writes nothing");

    run("--apply", &[]).good();
    for name in [
        "etc/udev/rules.d/70-depthrig.rules",
        "etc/tmpfiles.d/depthrig.conf",
        "etc/systemd/system/depthrig.service",
    ] {
        let text = std::fs::read_to_string(home.path().join("root").join(name)).unwrap();
        assert!(shown.contains(&text), "{name} is not what was shown");
    }
    assert!(!run("--print", &[]).good().contains("not installed"));
    assert!(run("--apply", &[]).good().matches("already up to date").count() == 3);

    let rules = home.path().join("root/etc/udev/rules.d/70-depthrig.rules");
    std::fs::write(&rules, "# mine\n").unwrap();
    for action in ["--apply", "--remove"] {
        let ran = run(action, &[]);
        assert_eq!(ran.code, 3, "{action}: {}", ran.out);
        assert!(ran.out.contains("changed by hand") && ran.out.contains("--overwrite"), "{}", ran.out);
        assert_eq!(std::fs::read_to_string(&rules).unwrap(), "# mine\n");
    }
    run("--remove", &["--overwrite"]).good();
    assert!(!rules.exists());
}

#[test]
fn one_action_is_asked_for_and_names_are_checked() {
    let home = Home::new();
    for bad in [
        &["install"][..],
        &["install", "--print", "--apply"],
        &["install", "--print", "--user", "a b"],
        &["install", "--print", "--data", "/a\nb"],
    ] {
        let ran = home.run(bad);
        assert_eq!(ran.code, 2, "{bad:?}: {}", ran.err);
    }
}

/// systemd reads its own files best. Where it is not installed, this says nothing.
#[test]
fn systemd_finds_nothing_wrong_with_the_service() {
    let home = Home::new();
    let root = home.path().join("root").to_str().unwrap().to_owned();
    home.run(&["install", "--apply", "--user", "daemon", "--root", &root]).good();
    let unit = format!("{root}/etc/systemd/system/depthrig.service");
    let Ok(said) = Command::new("systemd-analyze").args(["verify", "--man=no", &unit]).output() else {
        eprintln!("systemd-analyze is not installed; the service file is not verified");
        return;
    };
    let said = format!("{}{}", String::from_utf8_lossy(&said.stdout), String::from_utf8_lossy(&said.stderr));
    let ours: Vec<_> = said.lines().filter(|l| l.contains("depthrig.service")).collect();
    assert!(ours.is_empty(), "{ours:#?}");
}

/// Root without sudo is not a user of a rig.
#[test]
fn root_is_not_taken_for_the_rigs_user_unless_it_is_named() {
    let home = Home::new();
    let root = home.path().join("root");
    let ask = |action: &str, more: &[&str], env: &[(&str, &str)]| {
        let args = [&["install", action, "--root", root.to_str().unwrap()], more].concat();
        let mut command = Command::new(env!("CARGO_BIN_EXE_depthrig"));
        command.args(args).env_remove("SUDO_USER").env_remove("USER").envs(env.iter().copied());
        command.output().unwrap()
    };
    for env in [&[][..], &[("USER", "root")], &[("SUDO_USER", "root"), ("USER", "root")]] {
        let out = ask("--apply", &[], env);
        assert_eq!(out.status.code(), Some(2), "{env:?}");
        assert!(String::from_utf8_lossy(&out.stderr).contains("--user NAME"), "{out:?}");
        assert!(!root.exists(), "nothing is written");
    }
    let unit = root.join("etc/systemd/system/depthrig.service");
    for (more, env, user) in [
        (&[][..], &[("SUDO_USER", "robot"), ("USER", "root")][..], "User=robot\n"),
        (&["--user", "root"], &[], "User=root\n"),
        (&[], &[("USER", "lab")], "User=lab\n"),
    ] {
        assert!(ask("--apply", more, env).status.success());
        let text = std::fs::read_to_string(&unit).unwrap();
        assert!(text.contains(user), "{env:?}: {text}");
    }
    assert!(ask("--remove", &[], &[]).status.success(), "who removes need name nobody");
    assert!(!unit.exists());
}
