//! `depthrig install`: the udev rules, the limit of USB transfers and the service of a system.

use crate::exit::{Exit, UsageError};
use crate::install::{Done, Service, State, files};
use crate::out;
use anyhow::{Context, Result};
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
A file that somebody wrote or changed by hand is neither replaced nor removed without --overwrite.
Exit code 3 when such a file was left as it is.

Examples:
  depthrig install --print
  sudo depthrig install --apply --user robot --data /data/recordings
  sudo depthrig install --remove";

/// Arguments.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("action").required(true))]
#[allow(clippy::struct_excessive_bools)] // each is a flag of the command line
pub struct InstallArgs {
    /// Show the files, how each stands on this computer, and the commands that make them work
    #[arg(long, group = "action")]
    print: bool,
    /// Write the files (as root)
    #[arg(long, group = "action")]
    apply: bool,
    /// Remove the files (as root)
    #[arg(long, group = "action")]
    remove: bool,
    /// Replace or remove also what somebody changed by hand
    #[arg(long, alias = "force")]
    overwrite: bool,
    /// The user that the service runs as, which must be the one that uses the rig
    #[arg(long, value_name = "NAME", value_parser = user_name)]
    user: Option<String>,
    /// The rig's configuration for the service
    #[arg(long, value_name = "FILE", default_value = "/etc/depthrig/rig.toml")]
    rig_file: PathBuf,
    /// The folder that the service may record into
    #[arg(long, value_name = "DIR", default_value = "/var/lib/depthrig")]
    data: PathBuf,
    /// The folder that the system is in, for images of other computers
    #[arg(long, value_name = "DIR", default_value = "/")]
    root: PathBuf,
}

/// Shows, writes or removes.
pub fn run(args: &InstallArgs) -> Result<Exit> {
    let service = Service {
        user: service_user(args)?,
        binary: std::env::current_exe().context("the path of this program is not known")?,
        rig_file: absolute(&args.rig_file)?,
        data: absolute(&args.data)?,
    };
    let files = files(&service);
    if args.print {
        for file in &files {
            let state = match file.state(&args.root) {
                Ok(State::Missing) => "not installed".to_owned(),
                Ok(State::Current) => "installed".to_owned(),
                Ok(State::Older) => "installed with other contents".to_owned(),
                Ok(State::Changed) => "there, changed by hand".to_owned(),
                Err(e) => format!("unknown: {e}"),
            };
            out::line(format_args!("### {} ({}): {state}\n{}", file.path.display(), file.what, file.text))?;
        }
        out::line(format_args!("### then, as root\n{}", next_steps(&service)))?;
        return Ok(Exit::Good);
    }
    let mut refused = false;
    for file in &files {
        let done = if args.apply {
            file.install(&args.root, args.overwrite)?
        } else {
            file.remove(&args.root, args.overwrite)?
        };
        refused |= done == Done::Refused;
        let what = match done {
            Done::Written => "written",
            Done::Unchanged => "is as it should be",
            Done::Removed => "removed",
            Done::Absent => "was not there",
            Done::Refused => "was changed by hand and is left as it is (--overwrite takes it all the same)",
        };
        out::line(format_args!("{} ({}): {what}", file.below(&args.root).display(), file.what))?;
    }
    if args.apply {
        out::line(format_args!("\nNow, as root:\n{}", next_steps(&service)))?;
    } else {
        out::line("\nNow, as root:\n  systemctl daemon-reload\n  udevadm control --reload")?;
    }
    Ok(if refused { Exit::Lost } else { Exit::Good })
}

/// The commands that make the files work, in their order.
fn next_steps(service: &Service) -> String {
    let Service { user, rig_file, data, .. } = service;
    let (rig_file, data) = (rig_file.display(), data.display());
    format!(
        "\
  udevadm control --reload && udevadm trigger --settle    (or plug the cameras in again)
  systemd-tmpfiles --create /etc/tmpfiles.d/depthrig.conf
  usermod --append --groups video {user}                  (then {user} logs in again)

For the service:
  depthrig config show > {rig_file}               (and set recording.directory to {data} or below)
  install -d -o {user} {data}
  systemctl daemon-reload && systemctl enable --now depthrig
  DEPTHRIG_RUNTIME_DIR=/run/depthrig depthrig status      (as {user}; its subscribers need the variable too)

Then look: depthrig cameras, and depthrig doctor {rig_file}"
    )
}

/// The user that the service runs as: the one that is named, else who asked for root with sudo, else who asks. Root
/// itself must be named: a rig and its subscribers are one user's, and cameras need no root.
fn service_user(args: &InstallArgs) -> Result<String> {
    if let Some(user) = &args.user {
        return Ok(user.clone());
    }
    let named = |variable: &str| std::env::var(variable).ok().filter(|name| user_name(name).is_ok());
    let user = named("SUDO_USER").or_else(|| named("USER")).filter(|name| name != "root");
    match user {
        Some(user) => Ok(user),
        // What is removed does not depend on it.
        None if args.remove => Ok("root".to_owned()),
        None => Err(UsageError(
            "the service's user is not known: name the user that uses the rig with --user NAME (root only if it is meant)"
                .to_owned(),
        )
        .into()),
    }
}

/// A user name as systemd takes it (systemd.io, "User/Group Name Syntax"), strict form.
fn user_name(name: &str) -> Result<String, String> {
    let mut chars = name.chars();
    let first = chars.next().is_some_and(|c| c.is_ascii_alphabetic() || c == '_');
    let rest = chars.all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    if first && rest && name.len() <= 31 {
        Ok(name.to_owned())
    } else {
        Err("write the name of a user: letters, digits, `_` and `-`, no digit first".to_owned())
    }
}

fn absolute(path: &Path) -> Result<PathBuf> {
    let path = std::path::absolute(path).with_context(|| format!("{} is no path", path.display()))?;
    if path.to_string_lossy().contains(char::is_control) {
        let path = path.to_string_lossy().escape_debug().to_string();
        return Err(UsageError(format!("{path} has a line break or the like in it")).into());
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_systemd_takes_become_the_user() {
        for good in ["robot", "_apt", "a-b_1"] {
            assert!(user_name(good).is_ok(), "{good}");
        }
        for bad in ["", "1a", "a b", "a\nExecStart=/bin/sh", "root;", &"x".repeat(40)] {
            assert!(user_name(bad).is_err(), "{bad}");
        }
    }
}
