//! Many pairs and many modes at once: each thread takes the next task, and pairs come out in order.
//!
//! A pair is read and rectified once, whatever number of modes work on it, and presets share their matching. The pairs between reading and handing on are
//! bounded, and so are the matchers, which hold most of the memory.

use super::images::{Maker, ModeFrames, Views};
use super::input::{Head, Input, Next};
use super::modes::{Group, Worker};
use depthrig_bus::clock::thread_cpu_ns;
use depthrig_bus::sync::{lock, wait};
use depthrig_calib::stereo::DisparityMap;
use depthrig_recorder::{Error, ErrorKind, Result};
use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How long the caller waits before it is asked whether to go on.
const TIMEOUT: Duration = Duration::from_millis(100);

/// A pair with all frames computed from it.
pub(super) struct Done {
    pub(super) head: Head,
    /// `None` when the pair is not there or cannot be decoded.
    pub(super) computed: Option<(Arc<Views>, Vec<ModeFrames>)>,
    /// Why there is nothing, if it should be there.
    pub(super) problem: Option<String>,
}

/// Processor time, nanoseconds, of the threads that worked.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Cpu {
    pub(super) read: i64,
    pub(super) rectify: i64,
    /// By group of modes.
    pub(super) stereo: Vec<i64>,
    /// Disparity to depth and bytes.
    pub(super) depth: i64,
}

pub(super) struct Engine<'a> {
    pub(super) input: Mutex<&'a mut Input>,
    pub(super) maker: &'a Maker,
    pub(super) groups: &'a [Group],
    /// How many modes there are in all groups.
    pub(super) modes: usize,
    /// Workers of each group at most.
    pub(super) most: Vec<usize>,
    /// Threads.
    pub(super) jobs: usize,
    /// Pairs in work at most.
    pub(super) window: usize,
    pub(super) state: Mutex<State>,
    pub(super) wake: Condvar,
}

/// A pair in work.
struct Item {
    head: Head,
    views: Option<Arc<Views>>,
    problem: Option<String>,
    /// Groups that nobody has begun.
    todo: Vec<bool>,
    /// By mode.
    computed: Vec<Option<ModeFrames>>,
}

impl Item {
    fn is_done(&self, modes: usize) -> bool {
        self.problem.is_some() || self.head.left.is_none() || self.computed.iter().flatten().count() == modes
    }
}

#[derive(Default)]
pub(super) struct State {
    items: VecDeque<Item>,
    /// Number of the first of them.
    first: u64,
    reading: bool,
    ended: bool,
    stop: bool,
    failed: Option<Error>,
    /// Workers that nobody uses, and how many there are, by group.
    free: Vec<Vec<Worker>>,
    there: Vec<usize>,
    pub(super) cpu: Cpu,
}

impl State {
    /// With the workers that are there already, one of each group.
    pub(super) fn new(workers: Vec<Worker>) -> Self {
        let groups = workers.len();
        Self {
            free: workers.into_iter().map(|w| vec![w]).collect(),
            there: vec![1; groups],
            cpu: Cpu { stereo: vec![0; groups], ..Cpu::default() },
            ..Self::default()
        }
    }

    fn item(&mut self, number: u64) -> Option<&mut Item> {
        self.items.get_mut(usize::try_from(number.checked_sub(self.first)?).ok()?)
    }

    fn fail(&mut self, e: Error) {
        self.failed.get_or_insert(e);
        self.stop = true;
    }
}

/// A thread's next task.
enum Task {
    Match { number: u64, group: usize, views: Arc<Views>, worker: Option<Worker> },
    Read,
    Wait,
    End,
}

impl Engine<'_> {
    /// Works until there are no more pairs or `sink`, which gets them in order, breaks. `sink` is called with `None`
    /// while there is nothing. `false` when it broke.
    ///
    /// # Errors
    /// Errors of reading, matching and `sink`.
    pub(super) fn run(&self, sink: &mut dyn FnMut(Option<Done>) -> Result<ControlFlow<()>>) -> Result<bool> {
        std::thread::scope(|scope| {
            for n in 0..self.jobs {
                let thread = std::thread::Builder::new().name(format!("stereo-{n}"));
                if let Err(e) = thread.spawn_scoped(scope, || self.work()) {
                    let what = "cannot start a thread for stereo";
                    self.lock().fail(Error::new(ErrorKind::Io, what).with_source(e));
                }
            }
            let done = self.hand_on(sink);
            self.lock().stop = true;
            self.wake.notify_all();
            done
        })
    }

    /// The processor time that it took.
    pub(super) fn into_cpu(self) -> Cpu {
        self.state.into_inner().unwrap_or_else(PoisonError::into_inner).cpu
    }

    fn hand_on(&self, sink: &mut dyn FnMut(Option<Done>) -> Result<ControlFlow<()>>) -> Result<bool> {
        loop {
            let mut state = self.lock();
            if let Some(e) = state.failed.take() {
                return Err(e);
            }
            let done = if state.items.front().is_some_and(|i| i.is_done(self.modes)) {
                state.first += 1;
                state.items.pop_front().map(|item| {
                    let intact = item.problem.is_none();
                    let computed = item
                        .views
                        .filter(|_| intact)
                        .map(|v| (v, item.computed.into_iter().flatten().collect()));
                    Done { head: item.head, computed, problem: item.problem }
                })
            } else if state.ended && state.items.is_empty() {
                return Ok(true);
            } else {
                drop(self.wake.wait_timeout(state, TIMEOUT).unwrap_or_else(PoisonError::into_inner));
                None
            };
            self.wake.notify_all();
            if sink(done)?.is_break() {
                return Ok(false);
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn work(&self) {
        let mut maps = Vec::new();
        loop {
            let task = {
                let mut state = self.lock();
                loop {
                    match self.next_task(&mut state) {
                        Task::Wait => state = wait(&self.wake, state),
                        task => break task,
                    }
                }
            };
            let run = || match task {
                Task::Match { number, group, views, worker } => {
                    self.run_group(number, group, &views, worker, &mut maps)
                }
                Task::Read => self.read(),
                Task::Wait | Task::End => Ok(false),
            };
            let done = catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|_| {
                Err(Error::new(ErrorKind::Io, "a thread of the stereo engine panicked; its message is above"))
            });
            let goes_on = done.unwrap_or_else(|e| {
                self.lock().fail(e);
                false
            });
            self.wake.notify_all();
            if !goes_on {
                return;
            }
        }
    }

    /// The oldest pair first; reading only when there is nothing to match.
    fn next_task(&self, state: &mut State) -> Task {
        if state.stop {
            return Task::End;
        }
        let State { items, free, there, first, .. } = state;
        for (n, item) in items.iter_mut().enumerate() {
            let Some(views) = &item.views else { continue };
            for group in 0..self.groups.len() {
                if !item.todo[group] || (free[group].is_empty() && there[group] >= self.most[group]) {
                    continue;
                }
                item.todo[group] = false;
                let worker = free[group].pop();
                there[group] += usize::from(worker.is_none());
                return Task::Match { number: *first + n as u64, group, views: Arc::clone(views), worker };
            }
        }
        if !state.reading && !state.ended && state.items.len() < self.window {
            state.reading = true;
            return Task::Read;
        }
        let all_begun = state.items.iter().all(|i| i.views.is_some() && !i.todo.contains(&true));
        if state.ended && !state.reading && all_begun { Task::End } else { Task::Wait }
    }

    fn read(&self) -> Result<bool> {
        let begin = thread_cpu_ns();
        let next = lock(&self.input).next();
        let read = thread_cpu_ns() - begin;
        let mut state = self.lock();
        state.reading = false;
        state.cpu.read += read;
        let (head, raw, problem) = match next? {
            Next::End => {
                state.ended = true;
                return Ok(true);
            }
            Next::Pair(head, raw) => (head, raw, None),
            Next::Damaged(head, problem) => (head, None, Some(problem)),
        };
        let number = state.first + state.items.len() as u64;
        let todo = vec![raw.is_some(); self.groups.len()];
        let computed = (0..self.modes).map(|_| None).collect();
        state.items.push_back(Item { head, views: None, problem, todo, computed });
        drop(state);
        self.wake.notify_all();
        let Some(raw) = raw else { return Ok(true) };
        let begin = thread_cpu_ns();
        let views = self.maker.rectify(&raw)?;
        let rectify = thread_cpu_ns() - begin;
        let mut state = self.lock();
        state.cpu.rectify += rectify;
        if let Some(item) = state.item(number) {
            item.views = Some(Arc::new(views));
        }
        Ok(true)
    }

    fn run_group(
        &self,
        number: u64,
        group: usize,
        views: &Views,
        worker: Option<Worker>,
        maps: &mut Vec<DisparityMap>,
    ) -> Result<bool> {
        let of = &self.groups[group];
        let mut worker = match worker {
            Some(worker) => worker,
            None => of.make()?,
        };
        maps.resize_with(maps.len().max(of.modes.len()), DisparityMap::default);
        let maps = &mut maps[..of.modes.len()];
        let begin = thread_cpu_ns();
        let failed = |e: depthrig_calib::Error| {
            let what = format!("{} of pair {number}: {e}", of.name);
            Error::new(ErrorKind::BadInput, what).with_source(e)
        };
        worker.run(&views.pair(), maps).map_err(failed)?;
        let matched = thread_cpu_ns();
        let computed = maps.iter().map(|map| self.maker.depth(map)).collect::<Result<Vec<_>>>()?;
        let end = thread_cpu_ns();
        let mut state = self.lock();
        state.cpu.stereo[group] += matched - begin;
        state.cpu.depth += end - matched;
        state.free[group].push(worker);
        if let Some(item) = state.item(number) {
            for (mode, frames) in of.modes.iter().zip(computed) {
                item.computed[*mode] = Some(frames);
            }
        }
        Ok(true)
    }
}
