//! The other process of a test: the same binary started again, in a role.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};

/// Names the role in the environment of the other process.
pub const ROLE: &str = "DEPTHRIG_BUS_TEST_ROLE";
/// Names the folder that it works in.
pub const DIR: &str = "DEPTHRIG_BUS_TEST_DIR";

/// The test `helper_process` in a process of its own; killed when the test ends, whatever its end.
pub struct Helper(Child, BufReader<ChildStdout>);

impl Helper {
    /// Starts it in `role` and waits until it says that it is ready.
    pub fn start(dir: &Path, role: &str) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "helper_process", "--nocapture"])
            .env(ROLE, role)
            .env(DIR, dir)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let mut helper = Self(child, out);
        helper.wait_for("ready");
        helper
    }

    /// Waits for a line with `word` and returns it.
    pub fn wait_for(&mut self, word: &str) -> String {
        let mut line = String::new();
        while self.1.read_line(&mut line).unwrap() > 0 {
            if line.contains(word) {
                return line;
            }
            line.clear();
        }
        panic!("the helper process ended before it said \"{word}\"");
    }

    /// Kills it with SIGKILL.
    pub fn kill(mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Helper {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
