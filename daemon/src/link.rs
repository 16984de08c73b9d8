//! The clock of a session of several computers: asked for or answered, published as a signal, so that a recording has it, and read from
//! recordings.
//!
//! Its packets are signed with a key that the recorder's daemon makes anew each time it starts, and gives to the others over their control
//! connections ([`crate::hosts`]), which OpenSSH protects.
//!
//! Each computer publishes the signal `HOST/link_clock` ten times a second: what the session's clock said at that moment, and how wrong that may
//! be. Its values are recorded like those of any other signal, and put the frames of all computers on one clock when their datasets are
//! joined ([`crate::replay`]).

use crate::config::{LinkConfig, LinkRole};
use crate::status::{LinkState, LinkStatus};
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::signal::LINK_CLOCK;
use depthrig_bus::{
    FieldType, HostTime, RuntimeDir, SignalDescription, SignalField, SignalName, SignalPublisher,
    SignalSample, Signals, Value,
};
use depthrig_link::identity::of_this_clock;
use depthrig_link::{Answerer, Asker, Key, Reading, Trust};
use std::sync::atomic::{AtomicBool, Ordering};

/// From one sample to the next.
const EVERY: Duration = Duration::from_millis(100);
/// Without an answer for so long, the other computer is silent.
const SILENT_NS: i64 = 2_000_000_000;
/// Its fields, in the order of the values.
const FIELDS: [(&str, FieldType, &str); 5] = [
    ("clock", FieldType::I64, ""),
    ("epoch", FieldType::I64, ""),
    ("offset", FieldType::I64, "ns"),
    ("uncertainty", FieldType::I64, "ns"),
    ("rate", FieldType::F64, ""),
];

/// This computer's part.
#[derive(Debug)]
pub struct Link {
    config: LinkConfig,
    role: Role,
}

#[derive(Debug)]
enum Role {
    Recorder { answerer: Answerer, clock: u64, key: Option<Key> },
    Camera(Asker),
}

/// A sample of the signal: the clock of the session at a time of the host's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockSample {
    /// Which clock it is.
    pub clock: i64,
    /// It minus the host's.
    pub reading: Reading,
    /// The host's time.
    pub time: HostTime,
}

impl Link {
    /// Begins to answer or to ask.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when the address belongs to another computer or is taken.
    pub fn start(config: &LinkConfig) -> Result<Self> {
        let failed =
            |e: std::io::Error, what: String| Error::new(ErrorKind::BadInput, format!("{what}: {e}"));
        let role = match config.role {
            LinkRole::Recorder(at) => {
                let clock = of_this_clock().map_err(|e| failed(e, "this computer's clock".to_owned()))?;
                let what =
                    || format!("UDP {at} is refused; listen in [link] must be an address of this computer");
                let key = (!config.insecure)
                    .then(Key::random)
                    .transpose()
                    .map_err(|e| failed(e, "no key for the clock".to_owned()))?;
                let trust = key.clone().map_or(Trust::Anyone, Trust::Key);
                Role::Recorder {
                    answerer: Answerer::start(at, trust).map_err(|e| failed(e, what()))?,
                    clock,
                    key,
                }
            }
            LinkRole::Camera(at) => {
                let what = || format!("no thread asks for the clock of {at}");
                let trust = if config.insecure { Trust::Anyone } else { Trust::Nobody };
                Role::Camera(Asker::start(at, trust).map_err(|e| failed(e, what()))?)
            }
        };
        Ok(Self { config: config.clone(), role })
    }

    /// The key that the other computers get; `None` if this one records no session, or signs nothing.
    pub fn key(&self) -> Option<Key> {
        match &self.role {
            Role::Recorder { key, .. } => key.clone(),
            Role::Camera(_) => None,
        }
    }

    /// Takes the key of the computer that records the session; `false` on that computer.
    pub fn follow(&self, key: Option<&Key>) -> bool {
        let Role::Camera(asker) = &self.role else { return false };
        if let Some(key) = key
            && !self.config.insecure
        {
            asker.set_key(key.clone());
        }
        true
    }

    /// The session's clock at a time of this computer's; `None` if it is this computer's, or not known yet.
    pub fn at(&self, now: HostTime) -> Option<Reading> {
        match &self.role {
            Role::Recorder { .. } => None,
            Role::Camera(asker) => asker.at(now),
        }
    }

    /// The state of this computer's part.
    pub fn status(&self, now: HostTime) -> LinkStatus {
        let host = self.config.host.to_string();
        match &self.role {
            Role::Recorder { answerer, .. } => LinkStatus {
                host,
                insecure: self.config.insecure,
                recorder: None,
                state: LinkState::Own,
                offset_s: Some(0.0),
                uncertainty_us: Some(0.0),
                rate_ppm: Some(0.0),
                epoch: None,
                round_trip_us: None,
                age_s: None,
                exchanges: answerer.answered(),
                refused: answerer.refused(),
            },
            Role::Camera(asker) => {
                let s = asker.state();
                let reading = asker.at(now);
                let age_ns = now.since_ns(s.last_answer);
                let is_refused = now.since_ns(s.last_refusal) <= SILENT_NS;
                LinkStatus {
                    host,
                    insecure: self.config.insecure,
                    recorder: Some(asker.address().to_string()),
                    state: match reading {
                        Some(_) if age_ns <= SILENT_NS => LinkState::Live,
                        _ if is_refused => LinkState::Unkeyed,
                        Some(_) => LinkState::Silent,
                        None => LinkState::Unknown,
                    },
                    offset_s: reading.map(|r| r.offset_ns as f64 / 1e9),
                    uncertainty_us: reading.map(|r| r.uncertainty_ns as f64 / 1e3),
                    rate_ppm: reading.map(|r| r.rate * 1e6),
                    epoch: reading.map(|r| r.epoch),
                    round_trip_us: (reading.is_some() || is_refused).then_some(s.round_trip_ns as f64 / 1e3),
                    age_s: reading.map(|_| age_ns as f64 / 1e9),
                    exchanges: s.asked,
                    refused: s.refused,
                }
            }
        }
    }

    /// The clock's number and what it says now.
    fn reading(&self, now: HostTime) -> Option<(u64, Reading)> {
        match &self.role {
            Role::Recorder { clock, .. } => {
                Some((*clock, Reading { offset_ns: 0, uncertainty_ns: 0, rate: 0.0, epoch: 1 }))
            }
            Role::Camera(asker) => Some((asker.state().clock, asker.at(now)?)),
        }
    }

    /// Opens the signal's channel.
    ///
    /// # Errors
    /// Those of opening a channel; [`ErrorKind::InUse`] when another rig of this computer has this host's name.
    pub fn publisher(&self, runtime: &RuntimeDir) -> Result<ClockPublisher> {
        let place = Signals::open(runtime)?;
        let name: SignalName = format!("{}/{LINK_CLOCK}", self.config.host).parse()?;
        let description = SignalDescription::fields(
            name,
            FIELDS.map(|(name, kind, unit)| SignalField::new(name, kind, unit)).into(),
        )?;
        let publisher = place.publisher(&description)?;
        Ok(ClockPublisher { _place: place, publisher })
    }
}

/// Publishes the clock of the session.
pub struct ClockPublisher {
    /// It holds the channel open.
    _place: Signals,
    publisher: SignalPublisher,
}

impl ClockPublisher {
    /// Publishes until `stop`.
    pub fn run(mut self, link: &Link, stop: &AtomicBool) {
        let mut state = LinkState::Unknown;
        let mut failed = false;
        while !stop.load(Ordering::Relaxed) {
            let now = HostTime::now();
            if let Some((clock, r)) = link.reading(now) {
                let values = [
                    Value::I64(clock.cast_signed()),
                    Value::I64(r.epoch.into()),
                    Value::I64(r.offset_ns),
                    Value::I64(i64::try_from(r.uncertainty_ns).unwrap_or(i64::MAX)),
                    Value::F64(r.rate),
                ];
                let sent = self.publisher.publish(values);
                if let Err(e) = &sent
                    && !failed
                {
                    tracing::error!("the clock of the session is not published: {e}");
                }
                failed = sent.is_err();
            }
            log(&link.status(now), &mut state);
            std::thread::sleep(EVERY);
        }
    }
}

/// Logs when answers stop and begin.
fn log(status: &LinkStatus, state: &mut LinkState) {
    let Some(recorder) = &status.recorder else { return };
    let before = core::mem::replace(state, status.state);
    if before == status.state {
        return;
    }
    match status.state {
        LinkState::Silent => tracing::error!(
            "the clock of {recorder} no longer answers; capture and recording go on with the offset of before"
        ),
        LinkState::Live => tracing::info!(
            "the clock of {recorder} answers: {:+.6} s from this one within {:.0} us",
            status.offset_s.unwrap_or_default(),
            status.uncertainty_us.unwrap_or_default()
        ),
        LinkState::Unkeyed => tracing::warn!(
            "{recorder} answers, and has not given the key of its clock to this computer yet; capture and recording go on"
        ),
        LinkState::Own | LinkState::Unknown => {}
    }
}

/// Whether a signal is the session's clock.
pub fn is_clock(description: &SignalDescription) -> bool {
    let same = |(field, (name, kind, _)): (&SignalField, &(&str, FieldType, &str))| {
        field.name == *name && field.kind == *kind && field.count == 1
    };
    description.name().signal().as_str() == LINK_CLOCK
        && description.all_fields().len() == FIELDS.len()
        && description.all_fields().iter().zip(&FIELDS).all(same)
}

/// The values of a sample of the signal.
pub fn read(sample: &SignalSample) -> Option<ClockSample> {
    let mut values = sample.values();
    let (
        Some(Value::I64(clock)),
        Some(Value::I64(epoch)),
        Some(Value::I64(offset_ns)),
        Some(Value::I64(uncertainty)),
        Some(Value::F64(rate)),
    ) = (values.next(), values.next(), values.next(), values.next(), values.next())
    else {
        return None;
    };
    let reading = Reading {
        offset_ns,
        uncertainty_ns: u64::try_from(uncertainty).ok()?,
        rate,
        epoch: u32::try_from(epoch).ok()?,
    };
    Some(ClockSample { clock, reading, time: sample.time() })
}
