//! What a process may ask of the kernel so that cameras are served in time; refusals are hints, not errors.

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
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let raised = ThreadPriorityValue::try_from(CAMERA_PRIORITY).map_err(|e| format!("{e:?}")).and_then(|p| {
        set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(p), policy)
            .map_err(|e| format!("{e:?}"))
    });
    if let Err(e) = raised {
        HINT.call_once(|| {
            tracing::info!(
                reason = e,
                "camera threads run at ordinary priority, so a busy machine can delay frames; allow real-time priority \
                 (ulimit -r 20, or LimitRTPRIO=20 in the service), or set raise_priority = false"
            );
        });
    }
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
