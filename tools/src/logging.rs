//! Logs on the standard error output: text for people, or JSON lines for machines.

use crate::cli::{Global, LogFormat};
use crate::context::wants_color;
use std::io::IsTerminal;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::fmt;

/// Starts logging as `global` asks, by `loudness` steps louder than usual.
pub fn start(global: &Global, loudness: i32) {
    let level = level(i32::from(global.verbose) - i32::from(global.quiet) + loudness);
    let no_color = std::env::var_os("NO_COLOR").is_some_and(|v| !v.is_empty());
    let color = wants_color(global.color, no_color, std::io::stderr().is_terminal());
    let logs = fmt().with_max_level(level).with_writer(std::io::stderr).with_target(global.verbose > 1);
    match global.log_format {
        LogFormat::Text => logs.with_ansi(color).init(),
        LogFormat::Json => logs.json().flatten_event(true).init(),
    }
}

/// Warnings without an option; more with each `-v`, less with each `-q`.
const fn level(loudness: i32) -> LevelFilter {
    match loudness {
        ..=-2 => LevelFilter::OFF,
        -1 => LevelFilter::ERROR,
        0 => LevelFilter::WARN,
        1 => LevelFilter::INFO,
        2 => LevelFilter::DEBUG,
        3.. => LevelFilter::TRACE,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels() {
        assert_eq!(level(0), LevelFilter::WARN);
        assert_eq!(level(1), LevelFilter::INFO);
        assert_eq!(level(9), LevelFilter::TRACE);
        assert_eq!(level(-1), LevelFilter::ERROR);
        assert_eq!(level(-5), LevelFilter::OFF);
    }
}
