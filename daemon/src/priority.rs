//! Thread priorities, so that cameras are served in time; refusals are hints, not errors.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::sync::Once;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Real-time priority of camera threads: above everything ordinary, below the kernel's own interrupt threads (50).
const CAMERA_PRIORITY: u8 = 10;

/// Puts the calling thread into the real-time class `SCHED_FIFO`. When the kernel refuses, one hint is logged.
pub fn raise_current_thread() {
    static HINT: Once = Once::new();
    if let Err(e) = raise() {
        HINT.call_once(|| {
            tracing::info!(
                reason = e,
                "camera threads run at ordinary priority, so a busy machine can delay frames; allow real-time priority \
                 (ulimit -r 20, or LimitRTPRIO=20 in the service), or set raise_priority = false"
            );
        });
    }
}

/// Niceness of threads that refine depth: below any camera or subscriber, above reports.
const REFINE_NICE: i32 = 10;

/// Puts the calling thread, and the threads it starts from now on, below all others that somebody waits for.
pub fn lower_current_thread() {
    // Of this thread alone on Linux; refused it is merely as urgent as others.
    if let Err(e) = rustix::process::nice(REFINE_NICE) {
        tracing::debug!(error = %e, "a thread that refines depth keeps its priority");
    }
}

/// Why a thread of this process gets no real-time priority; `None` when it does. Tried on a thread of its own.
pub fn refusal() -> Option<String> {
    let tried = std::thread::Builder::new().name("priority".into()).spawn(raise);
    match tried.map(std::thread::JoinHandle::join) {
        Ok(Ok(raised)) => raised.err(),
        Ok(Err(_)) => Some("the thread that tried it ended early".to_owned()),
        Err(e) => Some(e.to_string()),
    }
}

fn raise() -> Result<(), String> {
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let priority = ThreadPriorityValue::try_from(CAMERA_PRIORITY).map_err(|e| format!("{e:?}"))?;
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(priority), policy)
        .map_err(|e| match e {
            thread_priority::Error::OS(code) => std::io::Error::from_raw_os_error(code).to_string(),
            e => format!("{e:?}"),
        })
}

/// Raises the soft limit of open files to the hard one: every channel costs some files per subscriber.
pub fn raise_file_limit() {
    let limit = getrlimit(Resource::Nofile);
    if limit.current != limit.maximum {
        let raised = Rlimit { current: limit.maximum, maximum: limit.maximum };
        if let Err(e) = setrlimit(Resource::Nofile, raised) {
            tracing::debug!(error = %e, "the limit of open files stays as it is");
        }
    }
}
