//! The program `depthrig-ros2`, kept running beside the rig: it is a subscriber like any other, and nothing here depends on it.

use crate::config::Ros2Config;
use crate::status::Ros2Status;
use core::time::Duration;
use depthrig_bus::runtime::RUNTIME_DIR_VARIABLE;
use depthrig_bus::sync::lock;
use depthrig_bus::{RigName, RuntimeDir};
use depthrig_driver::ErrorKind;
use depthrig_external::process::{Keeper, Owner, Program};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// The program, unless the rig file names another.
const PROGRAM: &str = "depthrig-ros2";
const CURE: &str = "pip install 'depthrig[ros2]', or name the program as command in [ros2]";
const LOOK: Duration = Duration::from_millis(100);
/// A program that does not exist may have been installed since.
const LOOKS_UNTIL_NEXT_TRY: u32 = 50;

/// The program of a rig.
#[derive(Debug)]
pub struct Ros2 {
    program: Program,
    status: Mutex<Ros2Status>,
}

impl Ros2 {
    /// That of `rig`. Nothing is started before [`Self::run`].
    pub fn new(config: &Ros2Config, rig: &RigName, runtime: &RuntimeDir) -> Self {
        let mut command = config.command.clone();
        if command.is_empty() {
            let own = std::env::current_exe().ok();
            command
                .push(beside(own.as_deref()).map_or_else(|| PROGRAM.to_owned(), |p| p.display().to_string()));
        }
        command.extend(["--rig".to_owned(), rig.to_string()]);
        let program = Program {
            owner: Owner::Rig("ros2"),
            command,
            directory: config.directory.clone(),
            environment: vec![(RUNTIME_DIR_VARIABLE, runtime.path().into())],
        };
        Self {
            program,
            status: Mutex::new(Ros2Status { pid: None, why: Some("it was not started yet".to_owned()) }),
        }
    }

    /// Its process, or the reason why it does not run.
    pub fn status(&self) -> Ros2Status {
        lock(&self.status).clone()
    }

    /// Keeps it running until `stop`, and ends it then.
    pub fn run(&self, stop: &AtomicBool) {
        let mut keeper = Keeper::new(self.program.clone());
        let mut looks_left = 0;
        while !stop.load(Ordering::Relaxed) {
            if looks_left == 0 {
                let mut why = None;
                if let Err(e) = keeper.ensure() {
                    // How a process ended is logged by its keeper; that there is none is said here, once.
                    if e.kind() == ErrorKind::BadInput {
                        looks_left = LOOKS_UNTIL_NEXT_TRY;
                        why = Some(format!("{e}; {CURE}"));
                        if lock(&self.status).why != why {
                            tracing::error!(program = "ros2", "{e}; {CURE}");
                        }
                    } else {
                        why = Some(e.to_string());
                    }
                }
                *lock(&self.status) = Ros2Status { pid: keeper.pid(), why };
            }
            looks_left = looks_left.saturating_sub(1);
            std::thread::sleep(LOOK);
        }
        drop(keeper);
        *lock(&self.status) = Ros2Status { pid: None, why: Some("it ended with the rig".to_owned()) };
    }
}

/// The program of the Python package in whose folder of programs this one is.
fn beside(own: Option<&Path>) -> Option<PathBuf> {
    let path = own?.parent()?.join(PROGRAM);
    path.is_file().then_some(path)
}
