//! The control thread never holds anybody up, whatever the camera does.

use super::*;
use crate::protocol::health::ERROR_SELECTOR;
use crate::protocol::hwm::Request;
use core::sync::atomic::AtomicBool;
use std::sync::Mutex;

/// Fake controls of a camera.
#[derive(Clone, Default)]
struct FakeCamera {
    /// Every request takes this long, as one that runs into the kernel's time-out.
    hangs: Option<Duration>,
    fails: Option<ErrorKind>,
    fault: Arc<Mutex<u8>>,
    asked: Arc<Mutex<Vec<&'static str>>>,
    gone: Arc<AtomicBool>,
}

impl FakeCamera {
    fn answer(&self, what: &'static str) -> Result<()> {
        self.asked.lock().unwrap().push(what);
        if let Some(time) = self.hangs {
            std::thread::sleep(time);
        }
        if self.gone.load(Ordering::Relaxed) {
            return Err(Error::new(ErrorKind::Disconnected, "gone"));
        }
        self.fails.map_or(Ok(()), |kind| Err(Error::new(kind, "made to fail")))
    }

    fn count(&self, what: &str) -> usize {
        self.asked.lock().unwrap().iter().filter(|w| **w == what).count()
    }

    fn spawn(&self) -> Control {
        Control::spawn("D435 1".to_owned(), Family::D4xx, Box::new(self.clone()), Box::new(self.clone()))
            .unwrap()
    }
}

impl HardwareMonitor for FakeCamera {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        assert_eq!(request, &Request::clock());
        self.answer("clock").map(|()| 0x0102_0304_u32.to_le_bytes().to_vec())
    }
}

impl ControlPort for FakeCamera {
    fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()> {
        assert_eq!((unit, query), (3, Query::GetCur));
        if selector == ERROR_SELECTOR {
            self.answer("fault")?;
            data.copy_from_slice(&[*self.fault.lock().unwrap()]);
        } else {
            self.answer("temperature")?;
            data.copy_from_slice(&[1, 1, 44, 40]);
        }
        Ok(())
    }
}

fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = HostTime::now().plus(Duration::from_secs(30));
    while !is_so() {
        assert!(!deadline.from_now().is_zero(), "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn probes_come_fast_at_first_and_bracket_the_answer() {
    let fake = FakeCamera::default();
    let began = HostTime::now();
    let control = fake.spawn();
    let mut probes = Vec::new();
    wait_until("five probes", || {
        probes.extend(control.probes());
        probes.len() >= 5
    });
    // Five at 100 ms; at one per second it would be four seconds.
    assert!(began.elapsed() < Duration::from_secs(3), "{:?}", began.elapsed());
    assert!(probes.iter().all(|p| p.ticks == 0x0102_0304 && p.before <= p.after && p.before >= began));
}

#[test]
fn faults_and_temperature_are_looked_at_each_second() {
    let fake = FakeCamera::default();
    *fake.fault.lock().unwrap() = 1;
    let control = fake.spawn();
    assert!(control.temperature_c().is_nan());
    wait_until("a temperature", || !control.temperature_c().is_nan());
    assert!((control.temperature_c() - 44.0).abs() < f32::EPSILON);
    wait_until("two looks", || fake.count("fault") >= 2);
}

#[test]
fn a_camera_whose_controls_hang_delays_nobody() {
    let fake = FakeCamera { hangs: Some(Duration::from_secs(2)), ..FakeCamera::default() };
    let control = fake.spawn();
    wait_until("the first request", || fake.count("clock") == 1);
    let began = HostTime::now();
    assert_eq!(control.probes().count(), 0);
    assert!(control.temperature_c().is_nan());
    drop(control);
    assert!(began.elapsed() < Duration::from_secs(1), "{:?}", began.elapsed());
}

#[test]
fn after_a_failure_the_camera_is_left_alone_and_asked_again_later() {
    let fake = FakeCamera { fails: Some(ErrorKind::Io), ..FakeCamera::default() };
    let control = fake.spawn();
    wait_until("the failure", || control.failed_and_overrun().0 == 1);
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(fake.count("clock"), 1, "not every 100 ms");
    assert_eq!(fake.count("fault"), 0);
}

#[test]
fn the_thread_ends_by_itself_when_the_camera_is_gone() {
    let fake = FakeCamera::default();
    fake.gone.store(true, Ordering::Relaxed);
    let control = fake.spawn();
    wait_until("the end", || control.thread.as_ref().is_some_and(JoinHandle::is_finished));
    assert_eq!(fake.count("clock"), 1);
}

#[test]
fn probes_that_nobody_takes_are_counted_and_bounded() {
    let fake = FakeCamera::default();
    let (send, _keep) = sync_channel(1);
    let shared = Arc::new(Shared::default());
    let mut worker = Worker {
        label: String::new(),
        family: Family::D4xx,
        monitor: Box::new(fake.clone()),
        port: Box::new(fake),
        shared: Arc::clone(&shared),
        send,
        fault: 0,
        polls: true,
        failing: false,
    };
    for _ in 0..3 {
        worker.probe().unwrap();
    }
    assert_eq!(shared.overrun.load(Ordering::Relaxed), 2);
}
