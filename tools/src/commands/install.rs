//! `depthrig install`: installs udev rules, the USB transfer limit and the systemd service.

use crate::exit::{Exit, UsageError};
use crate::install::{Done, Service, State, SystemFile, files};
use crate::out;
use anyhow::{Context, Result};
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Files changed by hand are neither replaced nor removed without --overwrite.

Exit codes: 0 success, 1 failure, 2 wrong usage, 3 a file changed by hand was kept.

Examples:
  depthrig install --print
  sudo depthrig install --apply --user robot --data /data/recordings
  sudo depthrig install --remove";

/// Arguments.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("action").required(true))]
#[allow(clippy::struct_excessive_bools)] // each is a flag of the command line
pub struct InstallArgs {
    /// Print the files with their state, and the commands that activate them
    #[arg(long, group = "action")]
    print: bool,
    /// Install the files (as root)
    #[arg(long, group = "action")]
    apply: bool,
    /// Remove the files (as root)
    #[arg(long, group = "action")]
    remove: bool,
    /// Also replace or remove files that were changed by hand
    #[arg(long, alias = "force")]
    overwrite: bool,
    /// User of the service and of the rig [default: the user who called sudo]
    #[arg(long, value_name = "NAME", value_parser = user_name)]
    user: Option<String>,
    /// Rig configuration of the service
    #[arg(long, value_name = "FILE", default_value = "/etc/depthrig/rig.toml")]
    rig_file: PathBuf,
    /// Folder that the service may record to
    #[arg(long, value_name = "DIR", default_value = "/var/lib/depthrig")]
    data: PathBuf,
    /// Root folder of the system, for mounted images of other computers
    #[arg(long, value_name = "DIR", default_value = "/")]
    root: PathBuf,
}

/// Prints, installs or removes the files.
pub fn run(args: &InstallArgs) -> Result<Exit> {
    let service = Service {
        user: service_user(args)?,
        binary: std::env::current_exe().context("the path of this program is unknown")?,
        rig_file: absolute(&args.rig_file)?,
        data: absolute(&args.data)?,
    };
    let files = files(&service);
    if args.print {
        for file in &files {
            let state = match file.state(&args.root) {
                Ok(State::Missing) => "not installed".to_owned(),
                Ok(State::Packaged) => format!("installed by the package{}", in_its_place(file, &args.root)),
                Ok(State::PackagedOther) => {
                    format!("not installed; the package has other contents{}", in_its_place(file, &args.root))
                }
                Ok(State::Current) => "installed".to_owned(),
                Ok(State::Older) => "installed with other contents".to_owned(),
                Ok(State::Changed) => "changed by hand".to_owned(),
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
            Done::Unchanged => "already up to date",
            Done::Removed => "removed",
            Done::Absent => "did not exist",
            Done::Refused => "was changed by hand and is kept; --overwrite replaces or removes it",
            Done::Packaged => "left to the package, which brings it",
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

/// The package's file in parentheses, for a message.
fn in_its_place(file: &SystemFile, root: &Path) -> String {
    file.packaged_below(root).map_or_else(String::new, |path| format!(" ({})", path.display()))
}

/// Commands that activate the files, in order.
fn next_steps(service: &Service) -> String {
    let Service { user, rig_file, data, .. } = service;
    let rig_file = rig_file.display();
    let data = data.display();
    format!(
        "\
  udevadm control --reload && udevadm trigger --settle    (or replug the cameras)
  systemd-tmpfiles --create depthrig.conf
  usermod --append --groups video {user}                  (then {user} logs in again)

For the service:
  depthrig config show > {rig_file}               (and set recording.directory to {data} or below)
  install -d -o {user} {data}
  systemctl daemon-reload && systemctl enable --now depthrig
  DEPTHRIG_RUNTIME_DIR=/run/depthrig depthrig status      (as {user}; its subscribers need the variable too)
For a rig of several computers (`[link]`), which the service may not reach by itself:
  systemctl edit depthrig                                 ([Service] and IPAddressAllow= with their addresses, such as 10.0.0.0/24)

Then look: depthrig cameras, and depthrig doctor {rig_file}"
    )
}

/// User of the service: `--user`, else the caller of sudo, else the current user. Root must be named explicitly: a rig
/// and its subscribers belong to one user, and cameras do not need root.
fn service_user(args: &InstallArgs) -> Result<String> {
    if let Some(user) = &args.user {
        return Ok(user.clone());
    }
    let named = |variable: &str| std::env::var(variable).ok().filter(|name| user_name(name).is_ok());
    let user = named("SUDO_USER").or_else(|| named("USER")).filter(|name| name != "root");
    match user {
        Some(user) => Ok(user),
        // Removing does not depend on the user.
        None if args.remove => Ok("root".to_owned()),
        None => Err(UsageError(
            "the user of the service is unknown; name the user of the rig with --user NAME".to_owned(),
        )
        .into()),
    }
}

/// Parses a user name in systemd's strict form (systemd.io, "User/Group Name Syntax").
fn user_name(name: &str) -> Result<String, String> {
    let mut chars = name.chars();
    let first = chars.next().is_some_and(|c| c.is_ascii_alphabetic() || c == '_');
    let rest = chars.all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    if first && rest && name.len() <= 31 {
        Ok(name.to_owned())
    } else {
        Err("invalid user name; use letters, digits, `_` and `-`, not starting with a digit".to_owned())
    }
}

fn absolute(path: &Path) -> Result<PathBuf> {
    let path = std::path::absolute(path).with_context(|| format!("invalid path {}", path.display()))?;
    if path.to_string_lossy().contains(char::is_control) {
        let path = path.to_string_lossy().escape_debug().to_string();
        return Err(UsageError(format!("invalid path {path}: it contains control characters")).into());
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
