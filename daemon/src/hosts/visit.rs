//! Actions that follow from one look at a host, and pulling what it records, which no action waits for.

use super::pull::{self, Pull, Pulled};
use super::session::{Part, Session};
use super::{Host, Hosts};
use crate::client::Client;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::sync::lock;
use std::sync::atomic::AtomicBool;

/// A part is pulled for so long before its files are listed again.
const PULL_FOR: Duration = Duration::from_millis(500);
/// A part that is not there so long after it was asked for never began: a request has an answer, or is given up, sooner.
const NEVER_BEGAN: Duration = Duration::from_secs(30);

impl Hosts {
    /// Begins (if it `may_begin`) and ends parts on a host, by what was seen of it last.
    pub(super) fn visit(&self, host: &Host, client: &Client, may_begin: bool) {
        self.end_part(host, client);
        let sessions = lock(&self.sessions).of(&host.config.name);
        let recorded = lock(&host.seen).recording.clone();
        for session in &sessions {
            let has_begun = |p: &&Part| p.is_asked && recorded.as_ref() == Some(&p.name);
            for part in session.parts.iter().filter(has_begun) {
                self.began(session, &part.name);
            }
        }
        for session in sessions.iter().filter(|session| may_begin && session.goes_on) {
            if !session.parts.iter().any(|p| recorded.as_ref() == Some(&p.name)) {
                self.begin_part(host, client, session, recorded.as_deref());
            }
        }
    }

    /// Ends what a host was seen to record, if it is a part of a recording that has ended.
    pub(super) fn end_part(&self, host: &Host, client: &Client) {
        let Some(part) = lock(&host.seen).recording.clone() else { return };
        if !lock(&self.sessions).is_over(&part) {
            return;
        }
        match client.record_stop() {
            Ok(_) => self.recorded(host, None),
            Err(e) => tracing::warn!("host {} does not end its part {part} yet: {e}", host.config.name),
        }
        self.changed.notify_all();
    }

    /// Pulls some of each part that the host has. Returns whether there is more.
    pub(super) fn pull_parts(&self, host: &Host, client: &Client, stop: &AtomicBool) -> bool {
        let name = &host.config.name;
        let mut is_busy = false;
        // Both of before: a part that nobody records when its files are listed is not closed later.
        let sessions = lock(&self.sessions).of(name);
        let recorded = lock(&host.seen).recording.clone();
        for session in &sessions {
            for part in session.parts.iter().filter(|p| p.host == *name && !p.is_complete) {
                let pull = Pull {
                    client,
                    name: &part.name,
                    folder: session.part_folder(&part.name),
                    reserve_bytes: self.reserve_bytes,
                    until: HostTime::now().plus(PULL_FOR),
                    stop,
                };
                is_busy |= self.pulled(host, session, &part.name, pull.run());
                if !session.goes_on && !is_busy && recorded.as_ref() != Some(&part.name) {
                    self.left_open(session, &part.name);
                }
            }
        }
        is_busy
    }

    /// Writes down the part that the host records now, before it is looked at again.
    fn recorded(&self, host: &Host, part: Option<String>) {
        lock(&host.seen).recording = part;
        self.changed.notify_all();
    }

    fn begin_part(&self, host: &Host, client: &Client, session: &Session, recorded: Option<&str>) {
        let name = &host.config.name;
        if let Some(other) = recorded {
            let what = format!(
                "it records {other}, which is no part of this recording; depthrig --host {name} record stop ends it"
            );
            let mut sessions = lock(&self.sessions);
            sessions.excuse_of(&session.name, name, what);
            // Whoever waits for it asks for the status at once, before the next look at the host.
            lock(&host.seen).why = sessions.excuse(name);
            drop(sessions);
            self.changed.notify_all();
            return;
        }
        let request = session.part_request(name);
        let Some(part) = request.name.clone() else { return };
        // Written down first: a part that begins is then known, whatever happens to the answer.
        lock(&self.sessions).add(&session.name, name, &part);
        match client.record_start(&request) {
            Ok(status) => {
                tracing::info!("host {name} records {}", status.name);
                self.began(session, &part);
                self.recorded(host, Some(status.name));
            }
            // It may have begun all the same: the next look says so.
            Err(e) if e.kind() == ErrorKind::Unreachable => {
                tracing::warn!("host {name} did not say whether it records {part}: {e}");
            }
            Err(e) => {
                let what = format!("it records nothing: {e}");
                let mut sessions = lock(&self.sessions);
                if sessions.excuse(name).as_ref() != Some(&what) {
                    tracing::error!("host {name}: {what}");
                }
                sessions.take_back(&session.name, name, &part, what);
                lock(&host.seen).why = sessions.excuse(name);
            }
        }
        self.changed.notify_all();
    }

    fn began(&self, session: &Session, part: &str) {
        lock(&self.sessions).change(&session.name, part, |part| part.is_asked = false);
    }

    /// A part that nobody records is incomplete because nobody closed it: its daemon was killed, and recovers it after its start.
    fn left_open(&self, session: &Session, part: &str) {
        lock(&self.sessions).change(&session.name, part, |part| {
            if !part.is_complete && part.why.is_none() {
                let what = "it was not closed there yet, which its daemon does; if it does not, call there: depthrig recover";
                part.why = Some(what.to_owned());
            }
        });
    }

    /// Writes down how far a part has come; whether there is more of it.
    pub(super) fn pulled(&self, host: &Host, session: &Session, part: &str, pulled: Result<Pulled>) -> bool {
        let Pulled { bytes, copied, is_complete, is_busy } = match pulled {
            Ok(pulled) => pulled,
            Err(e) if e.kind() == ErrorKind::NotFound && never_began(host, session, part) => {
                let what = format!("host {}: its part {part} never began", host.config.name);
                lock(&self.sessions).take_back(&session.name, &host.config.name, part, what);
                self.changed.notify_all();
                return false;
            }
            Err(e) => {
                lock(&self.sessions).change(&session.name, part, |part| part.why = Some(said(host, &e)));
                return false;
            }
        };
        if is_complete {
            tracing::info!("part {part} of host {} is here: {bytes} bytes", host.config.name);
        }
        lock(&self.sessions).change(&session.name, part, |part| {
            part.bytes = bytes;
            part.pulled_bytes = copied;
            part.is_complete = is_complete;
            part.why = None;
        });
        if is_complete {
            self.changed.notify_all();
        }
        is_busy
    }
}

/// True of a part that its host does not know and that was asked for in vain: so long ago that no request can be under way any more, and nothing of it
/// ever came here.
fn never_began(host: &Host, session: &Session, part: &str) -> bool {
    let recorded = lock(&host.seen).recording.clone();
    let is_old = |p: &Part| p.name == part && p.is_asked && p.since.elapsed() > NEVER_BEGAN;
    recorded.as_deref() != Some(part)
        && session.parts.iter().any(is_old)
        && !pull::growing(&session.part_folder(part)).exists()
}

fn said(host: &Host, e: &Error) -> String {
    format!("host {}: {e}", host.config.name)
}
