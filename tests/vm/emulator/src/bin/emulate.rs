//! `emulate`: emulated cameras for a shell, controlled over a Unix socket.
//!
//! ```text
//! emulate serve SOCKET [MODEL[,key=value…]]…    serves until the command quit
//! emulate ask SOCKET COMMAND…                   sends one command and prints the reply
//! ```

use anyhow::{Context, Result, bail};
use depthrig_emulator::console::Console;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::process::ExitCode;

const USAGE: &str = "usage: emulate serve SOCKET [MODEL[,key=value...]]... | emulate ask SOCKET COMMAND...";

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let result = match words.split_first() {
        Some((&"serve", [socket, models @ ..])) => serve(Path::new(socket), models),
        Some((&"ask", [socket, command @ ..])) => ask(Path::new(socket), &command.join(" ")),
        _ => {
            eprintln!("{USAGE}");
            return ExitCode::from(2);
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("emulate: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn serve(socket: &Path, models: &[&str]) -> Result<()> {
    let mut console = Console::default();
    for model in models {
        let reply = console.command(&format!("plug {}", model.replace(',', " ")))?;
        println!("{model}: {}", reply.unwrap_or_default());
    }
    // A socket that an earlier run left behind is in nobody's use; if it were, binding fails below.
    if UnixStream::connect(socket).is_err() {
        let _ = std::fs::remove_file(socket);
    }
    let listener =
        UnixListener::bind(socket).with_context(|| format!("no socket at {}", socket.display()))?;
    for line in listener.incoming() {
        if !talk(&mut console, &line?) {
            break;
        }
    }
    let _ = std::fs::remove_file(socket);
    Ok(())
}

/// Answers one caller; `false` when it said `quit`.
fn talk(console: &mut Console, line: &UnixStream) -> bool {
    let mut out = line;
    for text in BufReader::new(line).lines().map_while(Result::ok) {
        let reply = match console.command(&text) {
            Ok(Some(reply)) => reply,
            Ok(None) => {
                let _ = writeln!(out, "ok");
                return false;
            }
            Err(error) => format!("error {error}"),
        };
        if writeln!(out, "{reply}").is_err() {
            break; // the caller has gone
        }
    }
    true
}

fn ask(socket: &Path, command: &str) -> Result<()> {
    let mut line =
        UnixStream::connect(socket).with_context(|| format!("nobody serves {}", socket.display()))?;
    writeln!(line, "{command}")?;
    let mut reply = String::new();
    BufReader::new(&line).read_line(&mut reply)?;
    let reply = reply.trim_end();
    if let Some(error) = reply.strip_prefix("error ") {
        bail!("{error}");
    }
    println!("{reply}");
    Ok(())
}
