//! Conditions of a measurement: a number means nothing without them.

use serde::Serialize;

/// Where and under what load something was measured.
#[derive(Debug, Clone, Serialize)]
pub struct Conditions {
    /// Version of depthrig.
    pub depthrig: &'static str,
    /// `release`, or `debug` (whose numbers mean nothing).
    pub build: &'static str,
    /// CPU model as the kernel names it.
    pub cpu: String,
    /// Logical CPUs that this process may use.
    pub cores: usize,
    /// Kernel release.
    pub kernel: String,
    /// Bytes free in shared memory at the start.
    pub shm_free_bytes: u64,
    /// Load average of the last minute before the measurement.
    pub load_before: f64,
    /// The same after it.
    pub load_after: f64,
}

impl Conditions {
    /// Records the conditions now; [`Self::finish`] adds the load at the end.
    pub fn now() -> Self {
        let shm = std::path::Path::new(depthrig_bus::shm::SHM_DIR);
        Self {
            depthrig: env!("CARGO_PKG_VERSION"),
            build: if cfg!(debug_assertions) { "debug" } else { "release" },
            cpu: cpu_model(),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            kernel: rustix::system::uname().release().to_string_lossy().into_owned(),
            shm_free_bytes: depthrig_bus::shm::free_bytes(shm).unwrap_or(0),
            load_before: load_average(),
            load_after: 0.0,
        }
    }

    /// Takes the load average at the end of the measurement.
    pub fn finish(&mut self) {
        self.load_after = load_average();
    }

    /// Formats the conditions on one line.
    pub fn line(&self) -> String {
        let warning = if self.build == "debug" { "; DEBUG BUILD, numbers mean nothing" } else { "" };
        format!(
            "depthrig {} ({}), {} x {}, Linux {}, load average {:.1} before, {:.1} after{warning}",
            self.depthrig, self.build, self.cores, self.cpu, self.kernel, self.load_before, self.load_after,
        )
    }
}

fn cpu_model() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    info.lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(": ").map(|(_, model)| model.to_owned()))
        .unwrap_or_else(|| std::env::consts::ARCH.to_owned())
}

fn load_average() -> f64 {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    text.split(' ').next().and_then(|t| t.parse().ok()).unwrap_or(f64::NAN)
}
