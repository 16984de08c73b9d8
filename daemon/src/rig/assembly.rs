//! The set thread: reads every stream of the rig, makes frame sets, sends them and hands them to the recorder.
//!
//! It is a subscriber like any other, so that nothing it does can hold up a camera.

use super::Inner;
use super::join::{Held, LateStreams};
use super::motion::Units;
use crate::camera::Camera;
use crate::config::{LinkConfig, LinkRole, Phase};
use crate::sets::{Assembler, AssemblerConfig, FrameSet, PhasePolicy, Rhythm};
use crate::status::{CameraState, SetAccount};
use crate::stream::Stream;
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{Frame, HostTime, MemberRecord, SetHeader, SetPublisher, Subscriber};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// How long the thread sleeps at most, so that it sees a stop or a lost camera in time.
const IDLE: Duration = Duration::from_millis(50);
/// Frames of one stream that may wait for their set: with the recorder's queue they stay below what a
/// subscriber may hold (16).
const MAX_PENDING: usize = 6;

/// One stream as the set thread sees it.
struct Input {
    stream: Arc<Stream>,
    camera: Arc<Camera>,
    subscriber: Subscriber,
    /// Counts from before the assembler was last rebuilt.
    base: SetAccount,
    /// Frames that were published before the set thread came to listen.
    before: Option<u64>,
}

/// The set thread's state.
pub struct Assembly {
    inner: Arc<Inner>,
    inputs: Vec<Input>,
    assembler: Option<Assembler<Frame>>,
    publisher: SetPublisher,
    /// Computed streams, which join the sets that are recorded.
    late_streams: LateStreams,
    /// IMUs, which are not in sets.
    motion: Units,
    next_id: u64,
    incomplete: u64,
    /// Of the session's clock, when the ticks were last aligned.
    epoch: Option<u32>,
    /// That the ticks were last aligned to.
    phase_ns: i64,
}

impl Assembly {
    /// The set thread of a rig.
    ///
    /// # Errors
    /// Those of opening the channel of sets.
    pub fn new(inner: Arc<Inner>) -> crate::Result<Self> {
        let publisher = inner.shared.bus.set_publisher()?;
        let late_streams = LateStreams::new(&inner.config);
        Ok(Self {
            inner,
            inputs: Vec::new(),
            assembler: None,
            publisher,
            late_streams,
            motion: Units::default(),
            next_id: 1,
            incomplete: 0,
            epoch: None,
            phase_ns: 0,
        })
    }

    /// Runs until the rig stops.
    pub fn run(mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            self.find_streams();
            let deadline = self.assembler.as_ref().and_then(Assembler::next_deadline);
            let sleep = deadline.map_or(IDLE, |d| d.from_now().min(IDLE)).max(Duration::from_millis(1));
            self.inner.shared.frames.wait(sleep);
            // Before the first frame, which decides on the first tick.
            self.align(HostTime::now());
            self.read_frames();
            self.motion.read(&self.inner);
            self.late_streams.read();
            // While the cameras are being stopped, sets would miss those that ended first.
            if !self.inner.ending.load(Ordering::Relaxed) {
                self.send_sets();
            }
            self.late_streams.release(&self.inner);
        }
        // Frames that were on their way when the cameras stopped still count.
        self.read_frames();
        self.motion.read(&self.inner);
        self.late_streams.read();
        self.report();
    }

    /// Takes in the streams of cameras that opened since the last look.
    fn find_streams(&mut self) {
        let mut found = false;
        for camera in &self.inner.cameras {
            let state = camera.state();
            let known = self.inputs.iter().filter(|i| Arc::ptr_eq(&i.camera, camera)).count();
            let at_once = state
                .streams
                .iter()
                .filter(|s| !camera.config.joins_late(&s.id.stream) && !s.profile.format.is_motion());
            for stream in at_once.skip(known) {
                let Some(subscriber) = stream.books().reader.take() else {
                    break; // its channel is just being created
                };
                self.inputs.push(Input {
                    stream: Arc::clone(stream),
                    camera: Arc::clone(camera),
                    subscriber,
                    base: SetAccount::default(),
                    before: None,
                });
                found = true;
            }
            self.late_streams.find(camera, &state);
            self.motion.find(&state);
        }
        if found {
            self.rebuild();
        }
        let Some(assembler) = &mut self.assembler else { return };
        for (i, input) in self.inputs.iter().enumerate() {
            let phase = input.camera.state().phase;
            assembler.set_stream_active(i, matches!(phase, CameraState::Opening | CameraState::Streaming));
        }
    }

    /// Makes an assembler for the streams there are now; frames that waited in the old one are let go.
    fn rebuild(&mut self) {
        if let Some(old) = self.assembler.take() {
            for (input, account) in self.inputs.iter_mut().zip(old.accounts()) {
                let mut sum = add(&input.base, account);
                sum.overflow += core::mem::take(&mut sum.pending);
                input.base = sum;
            }
        }
        let sets = &self.inner.config.sets;
        let periods: Vec<i64> = self.inputs.iter().map(|i| i.stream.profile.period_ns() as i64).collect();
        let mut config = AssemblerConfig::new(self.period_ns(), periods);
        config.max_pending = MAX_PENDING;
        if let Some(ms) = sets.max_wait_ms {
            config.max_wait_ns = (ms * 1e6) as i64;
        }
        config.phase = match (&self.inner.config.link, sets.phase) {
            (Some(LinkConfig { role: LinkRole::Camera(_), .. }), _) => PhasePolicy::Aligned,
            // Without [[link.hosts]] nobody says a phase to the others.
            (Some(link), _) if link.hosts.is_empty() => PhasePolicy::Fixed,
            (_, Phase::Fixed) => PhasePolicy::Fixed,
            (_, Phase::Auto) => PhasePolicy::MinimiseSpread,
        };
        self.epoch = None;
        self.assembler = Some(Assembler::new(config));
    }

    /// From one set to the next.
    fn period_ns(&self) -> i64 {
        (1e9 / self.inner.config.sets.rate_hz).round() as i64
    }

    fn read_frames(&mut self) {
        let Some(assembler) = &mut self.assembler else { return };
        for (i, input) in self.inputs.iter_mut().enumerate() {
            loop {
                match input.subscriber.try_next() {
                    Ok(Some(frame)) => {
                        // The rig numbers a stream's frames from 1.
                        input.before.get_or_insert(frame.header().sequence - 1);
                        let capture = HostTime::from_ns(frame.header().capture_time_ns);
                        assembler.push(i, capture, frame);
                    }
                    Ok(None) => break,
                    Err(e) => {
                        // All sixteen are held: the recorder is behind. Frames replaced meanwhile count as missed.
                        tracing::debug!(stream = %input.stream.id, error = %e, "cannot read");
                        break;
                    }
                }
            }
        }
    }

    fn send_sets(&mut self) {
        let now = HostTime::now();
        while let Some(set) = self.assembler.as_mut().and_then(|a| a.poll(now)) {
            self.send(set);
        }
        self.report();
    }

    /// Puts the ticks on the grid of the session's clock.
    fn align(&mut self, now: HostTime) {
        let period_ns = self.period_ns();
        let Some(assembler) = &mut self.assembler else { return };
        let grid = &self.inner.grid;
        if self.inner.hosts.is_some() {
            assembler.set_far(grid.others(now));
            if let Some(tick) = assembler.tick() {
                grid.set_phase_ns(tick.ns().rem_euclid(period_ns));
            }
        }
        if let Some(clock) = self.inner.link.as_ref().and_then(|link| link.at(now)) {
            let phase_ns = grid.phase_ns();
            let moved_ns = phase_ns.saturating_sub(self.phase_ns).rem_euclid(period_ns);
            // The other computer chose its phase anew, which it does at its start alone; later it moves by 1 % of a period.
            let jumped = moved_ns.min(period_ns - moved_ns) > period_ns / 40;
            self.phase_ns = phase_ns;
            let stepped = self.epoch.replace(clock.epoch) != Some(clock.epoch);
            assembler.align(clock.offset_ns.saturating_sub(phase_ns), stepped || jumped);
            let on_session =
                |r: Rhythm| Rhythm { newest_ns: r.newest_ns.saturating_add(clock.offset_ns), ..r };
            grid.set_own(assembler.rhythms().map(on_session));
        }
    }

    fn send(&mut self, set: FrameSet<Frame>) {
        let id = self.next_id;
        self.next_id += 1;
        let members: Vec<_> = self
            .inputs
            .iter()
            .zip(&set.members)
            .map(|(input, member)| MemberRecord {
                id: input.stream.id.clone(),
                sequence: member.as_ref().map(|m| m.item.header().sequence),
                capture_time_ns: member.as_ref().map_or(set.tick, |m| m.capture).ns(),
            })
            .collect();
        self.incomplete += u64::from(members.iter().any(|m| m.sequence.is_none()));
        let header = SetHeader {
            set_id: id,
            tick_ns: set.tick.ns(),
            spread_ns: set.spread_ns,
            incomplete: self.incomplete,
            ..SetHeader::default()
        };
        if let Err(e) = self.publisher.send(header, &members) {
            tracing::error!(set = id, error = %e, "a frame set could not be sent");
        }
        self.inner.spreads().add(set.spread_ns);
        let mut skews = lock(&self.inner.skews);
        for (input, member) in self.inputs.iter().zip(&set.members) {
            if let Some(member) = member {
                skews.entry(input.stream.id.clone()).or_default().add(member.skew_ns);
            }
        }
        drop(skews);
        self.inner.shared.stage.sets.note(set.tick, self.period_ns());
        let frames =
            self.inputs.iter().zip(set.members).map(|(i, m)| (Arc::clone(&i.stream), m.map(|m| m.item)));
        let closing = self.inner.closing.load(Ordering::Relaxed);
        if self.late_streams.are_awaited() && self.inner.recording().is_active() {
            if !closing {
                self.late_streams.hold(Held::new(id, set.tick, frames.collect()));
            }
        } else {
            self.inner.recording().offer(id, set.tick, frames);
        }
    }

    /// Puts the accounts where `status` finds them.
    fn report(&self) {
        let motion = self.motion.accounts(&self.inner);
        let mut accounts = self.inner.set_accounts();
        accounts.streams.extend(motion);
        let Some(assembler) = &self.assembler else { return };
        accounts.sent = self.next_id - 1;
        accounts.incomplete = self.incomplete;
        for (input, account) in self.inputs.iter().zip(assembler.accounts()) {
            let mut sum = add(&input.base, account);
            sum.missed = input.before.unwrap_or(0) + input.subscriber.missed();
            accounts.streams.insert(input.stream.id.clone(), sum);
        }
        accounts.streams.extend(self.late_streams.accounts());
    }
}

fn add(base: &SetAccount, a: &crate::sets::Account) -> SetAccount {
    SetAccount {
        used: base.used + a.used,
        decimated: base.decimated + a.decimated,
        late: base.late + a.late,
        out_of_order: base.out_of_order + a.out_of_order,
        overflow: base.overflow + a.overflow,
        missed: base.missed,
        pending: a.pending,
        unread: 0,
    }
}
