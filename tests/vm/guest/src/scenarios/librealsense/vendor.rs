//! The process in which Intel's library runs, and its answers (`tests/vm/librealsense/probe.py`).

use anyhow::{Context, bail};
use serde_json::Value;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

/// A running library.
pub struct Vendor {
    child: Child,
    requests: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Vendor {
    /// Starts the library in one of the versions that the archive has.
    ///
    /// # Errors
    /// When Python is missing or does not start.
    pub fn start(version: &str) -> anyhow::Result<Self> {
        let mut child = Command::new("/usr/bin/python3")
            .args(["-B", "-u", "/opt/librealsense/probe.py"])
            .env("PYTHONPATH", format!("/opt/librealsense-{version}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("Intel's library does not start")?;
        let requests = child.stdin.take().context("no way to ask")?;
        let answers = BufReader::new(child.stdout.take().context("no answers")?);
        Ok(Self { child, requests, answers })
    }

    /// The answer to a request.
    ///
    /// # Errors
    /// When the library ended, or the request failed there.
    pub fn ask(&mut self, request: &Value) -> anyhow::Result<Value> {
        writeln!(self.requests, "{request}").context("Intel's library ended")?;
        let mut line = String::new();
        if self.answers.read_line(&mut line)? == 0 {
            bail!("Intel's library ended while it was asked {request}: {:?}", self.child.wait());
        }
        let answer: Value = serde_json::from_str(&line)?;
        if let Some(error) = answer.get("error") {
            bail!("Intel's library: {request}: {error}");
        }
        Ok(answer)
    }

    /// Ends it.
    pub fn end(mut self) {
        // It fails when the library ended before, which the checks say.
        let _ = writeln!(self.requests, r#"{{"do": "quit"}}"#);
        let _ = self.child.wait();
    }
}

/// The numbers of a list.
pub fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().map(|all| all.iter().filter_map(Value::as_f64).collect()).unwrap_or_default()
}

/// The entries of a list.
pub fn entries(value: &Value) -> &[Value] {
    value.as_array().map(Vec::as_slice).unwrap_or_default()
}

/// A whole number of an entry.
pub fn whole(entry: &Value, key: &str) -> u64 {
    entry[key].as_u64().unwrap_or(u64::MAX)
}

/// A text of an entry.
pub fn text<'a>(entry: &'a Value, key: &str) -> &'a str {
    entry[key].as_str().unwrap_or_default()
}
