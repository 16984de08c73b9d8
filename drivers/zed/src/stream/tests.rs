use super::*;
use crate::hid::Reports;
use crate::imu;
use crate::profiles::profiles;
use crate::sensors::Record;
use depthrig_bus::{ClockDomain, DropReason, HostTime, MotionFlags, MotionSample};
use depthrig_driver::{ErrorKind, MemorySink};
use depthrig_v4l2::{FourCc, Interval, Mode};
use std::sync::mpsc::{SyncSender, sync_channel};

/// Side-by-side images of 8x3 pixels, with two bytes between rows.
const STRIDE: usize = 18;
const ROWS: usize = 3;

struct FakeImage {
    sequence: u64,
    bytes: Vec<u8>,
    damaged: bool,
    kernel: Option<i64>,
}

impl FakeImage {
    fn new(sequence: u64) -> Self {
        let bytes = (0..STRIDE * ROWS).map(|i| (i as u8) ^ (sequence as u8).wrapping_mul(0x55)).collect();
        let now = HostTime::now().ns();
        Self { sequence, bytes, damaged: false, kernel: Some(now - 5_000_000 + sequence as i64) }
    }

    fn image(&self, side: Side) -> Vec<u8> {
        let begin = if side == Side::Left { 0 } else { 8 };
        (0..ROWS).flat_map(|y| self.bytes[y * STRIDE + begin..][..8].to_vec()).collect()
    }
}

struct Images(Vec<FakeImage>);

impl ImageSource for Images {
    fn poll(&mut self, _: Duration, each: &mut dyn FnMut(&Image<'_>)) -> Result<bool> {
        if self.0.is_empty() {
            return Err(Error::new(ErrorKind::Disconnected, "unplugged"));
        }
        for m in self.0.drain(..) {
            each(&Image {
                source: 0,
                bytes: &m.bytes,
                damaged: m.damaged,
                sequence: m.sequence,
                kernel_time: m.kernel.map(HostTime::from_ns),
                arrival: HostTime::now(),
                header: None,
            });
        }
        Ok(true)
    }
}

fn stream(sides: &[Side], images: Vec<FakeImage>, settled: Option<Receiver<Result<()>>>) -> ZedStream {
    let mode = Mode {
        format: FourCc(*b"YUYV"),
        width: 8,
        height: ROWS as u32,
        interval: Interval { numerator: 1, denominator: 30 },
    };
    let all = profiles("ZED", &[mode], None).unwrap();
    let chosen = sides.iter().map(|s| (*s, all[usize::from(*s == Side::Right)].clone())).collect();
    ZedStream::new(
        "ZED 2i 7 at USB port 1-1".to_owned(),
        chosen,
        Box::new(Images(images)),
        STRIDE,
        None,
        settled,
    )
}

#[test]
fn each_side_gets_its_half_once_with_the_kernels_time() {
    let images = || [7, 8, 9].map(FakeImage::new);
    let mut sink = MemorySink::default();
    let source = images();
    let times: Vec<_> = source.iter().map(|m| m.kernel.unwrap()).collect();
    let before = depthrig_driver::unpack::copied_bytes();
    let mut s = stream(&Side::BOTH, source.into(), None);
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame);
    assert!(depthrig_driver::unpack::copied_bytes() - before >= 3 * 16 * ROWS as u64);
    assert_eq!(sink.frames.len(), 6);
    for (n, want) in images().iter().enumerate() {
        for (i, side) in Side::BOTH.into_iter().enumerate() {
            let (stream, meta, pixels) = &sink.frames[2 * n + i];
            assert_eq!((*stream, pixels), (i, &want.image(side)));
            assert_eq!((meta.device_sequence, meta.capture_time.ns()), (want.sequence, times[n]));
            assert_eq!(meta.clock_domain, ClockDomain::Kernel);
            assert!(meta.temperature_c.is_nan());
        }
    }
    let gone = s.poll(Duration::ZERO, &mut sink).unwrap_err();
    assert_eq!(gone.kind(), ErrorKind::Disconnected);
    assert_eq!(gone.to_string(), "ZED 2i 7 at USB port 1-1: unplugged");
}

#[test]
fn one_side_alone_is_the_first_stream() {
    let mut sink = MemorySink::default();
    let mut s = stream(&[Side::Right], vec![FakeImage::new(3)], None);
    assert_eq!(s.profiles()[0].stream.as_str(), "right");
    s.poll(Duration::ZERO, &mut sink).unwrap();
    assert_eq!((sink.frames.len(), sink.frames[0].0), (1, 0));
    assert_eq!(sink.frames[0].2, FakeImage::new(3).image(Side::Right));
}

/// Every incomplete image costs each side one frame, with its reason.
#[test]
fn incomplete_images_are_counted_for_both_sides() {
    let cut = |sequence, bytes: usize| {
        let mut m = FakeImage::new(sequence);
        m.bytes.resize(bytes, 0);
        m
    };
    let damaged = FakeImage { damaged: true, ..FakeImage::new(2) };
    let whole = STRIDE * ROWS;
    // Number 6 never comes.
    let images = vec![
        FakeImage::new(1),
        damaged,
        cut(3, whole - 1),
        cut(4, whole + 1),
        cut(5, 0),
        cut(7, 1),
        FakeImage::new(8),
        FakeImage::new(8),
    ];
    let mut sink = MemorySink::default();
    let mut s = stream(&Side::BOTH, images, None);
    s.poll(Duration::ZERO, &mut sink).unwrap();
    for i in 0..2 {
        let drops = sink.drops_of(i);
        let expected = [
            (DropReason::DeviceError, 1),
            (DropReason::Incomplete, 3),
            (DropReason::WrongSize, 1),
            (DropReason::DeviceGap, 1),
            (DropReason::OutOfOrder, 1),
        ];
        for (reason, n) in expected {
            assert_eq!(drops.get(reason), n, "{reason:?} of stream {i}");
        }
        assert_eq!((sink.delivered(i), sink.captured[i]), (2, 9));
    }
}

#[test]
fn an_eye_without_memory_does_not_cost_the_other() {
    let mut sink = MemorySink::default();
    sink.refuse = 1;
    let mut s = stream(&Side::BOTH, vec![FakeImage::new(1)], None);
    s.poll(Duration::ZERO, &mut sink).unwrap();
    assert_eq!(sink.drops_of(0).get(DropReason::NoSlot), 1);
    assert_eq!((sink.delivered(0), sink.delivered(1)), (0, 1));
}

#[test]
fn a_camera_that_cannot_be_set_ends_the_stream_with_the_reason() {
    let (send, receive) = sync_channel(1);
    let mut s = stream(&Side::BOTH, vec![FakeImage::new(1)], Some(receive));
    let mut sink = MemorySink::default();
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame, "nothing is known yet");
    send.send(Err(Error::new(ErrorKind::Protocol, "does not take the gain"))).unwrap();
    assert!(s.poll(Duration::ZERO, &mut sink).unwrap_err().to_string().contains("does not take the gain"));
    let (send, receive) = sync_channel(1);
    let mut s = stream(&Side::BOTH, vec![FakeImage::new(1)], Some(receive));
    send.send(Ok(())).unwrap();
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame);
}

#[test]
fn wrong_sizes_stay_wrong_for_each_side() {
    // Complete, too long, empty, and incomplete whatever it rounds to.
    let sizes = [100, 101, 0, 99, 98, 1].map(|came| own_bytes(came, 100, 50));
    assert_eq!(sizes, [50, 51, 0, 49, 49, 1]);
    // Rows with much padding: half of what came could be more than one side has.
    assert_eq!(own_bytes(199, 200, 50), 49);
}

/// A fake IMU that sends the given records, and is gone when the sender is dropped.
struct Unit(std::sync::mpsc::Receiver<Record>);

impl Reports for Unit {
    fn send_feature(&mut self, _: [u8; 2]) -> Result<()> {
        Ok(())
    }

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Option<usize>> {
        use std::sync::mpsc::RecvTimeoutError;
        match self.0.recv_timeout(timeout) {
            Ok(record) => {
                let bytes = record.build();
                into[..bytes.len()].copy_from_slice(&bytes);
                Ok(Some(bytes.len()))
            }
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(Error::new(ErrorKind::Disconnected, "pulled")),
        }
    }
}

/// Record number `n`, 2.5 ms after the one before.
fn record(n: u64) -> Record {
    Record {
        motion_valid: n % 50 != 49,
        ticks: 900 + 64 * n,
        gyro_raw: [n as i16, -1, if n == 7 { i16::MAX } else { 3 }],
        acceleration_raw: [1, 3337, if n == 9 { i16::MIN } else { n as i16 }],
        frame_sync: n.is_multiple_of(13),
        temperature_raw: if n < 5 { -27_315 } else { 3000 + n as i16 },
        ..Record::default()
    }
}

/// A camera with an IMU that has sent the records in `numbers`, all of which were read from it.
fn with_unit(images: Vec<FakeImage>, numbers: impl Iterator<Item = u64>) -> (ZedStream, SyncSender<Record>) {
    let (send, records) = sync_channel(4096);
    let wanted = numbers.map(|n| send.send(record(n)).unwrap()).count() as u64;
    let (unit, samples) = Motion::start_streaming(Box::new(Unit(records)), "ZED 2i 7").unwrap();
    let until = HostTime::now().plus(Duration::from_secs(20));
    while unit.tally().records < wanted {
        assert!(!until.from_now().is_zero(), "the records are not read");
        std::thread::sleep(Duration::from_millis(1));
    }
    let mut s = stream(&Side::BOTH, images, None);
    s.motion = Some(unit);
    (s.with_imu(imu::profile().unwrap(), samples), send)
}

fn motion_of(sink: &MemorySink, stream: usize) -> Vec<MotionSample> {
    sink.frames.iter().filter(|f| f.0 == stream).flat_map(|f| MotionSample::all_in(&f.2)).collect()
}

#[test]
fn every_sample_of_the_unit_is_in_a_batch_with_its_values() {
    // Numbers 20 to 22 never come.
    let (mut s, _unit) = with_unit(vec![FakeImage::new(1)], (0..20).chain(23..100));
    assert_eq!(s.profiles()[2].describe(), imu::profile().unwrap().describe());
    let mut sink = MemorySink::default();
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame);
    // A batch that does not fill goes when it is old.
    s.images = Some(Box::new(Silent));
    std::thread::sleep(depthrig_driver::motion::LONGEST);
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame);
    assert_eq!((sink.delivered(0), sink.delivered(1)), (1, 1));
    let samples = motion_of(&sink, 2);
    let numbers: Vec<_> = samples.iter().map(|m| m.sequence).collect();
    assert_eq!(numbers, (1..21).chain(24..101).collect::<Vec<_>>(), "a gap where the IMU gave none");
    let sizes: Vec<_> = sink.frames.iter().filter(|f| f.0 == 2).map(|f| f.2.len() / 64).collect();
    assert_eq!(sizes, [16, 16, 16, 16, 16, 16, 1]);
    assert_eq!(sink.drops_of(2).total(), 0);
    assert_eq!((sink.captured[2], sink.delivered(2)), (7, 7));
    for m in &samples {
        let r = record(m.sequence - 1);
        assert_eq!(m.device_time, r.ticks);
        if r.motion_valid {
            assert_eq!(m.gyro_rad_s, r.gyro_rad_s().map(|v| v as f32));
            assert_eq!(m.accel_m_s2, r.acceleration_m_s2().map(|v| v as f32));
        } else {
            assert!(m.gyro_rad_s.iter().chain(&m.accel_m_s2).all(|v| v.is_nan()));
        }
        assert_eq!(m.has(MotionFlags::FRAME_SYNC), r.frame_sync);
        assert_eq!(m.has(MotionFlags::GYRO_CLIPPED), m.sequence == 8);
        assert_eq!(m.has(MotionFlags::ACCEL_CLIPPED), m.sequence == 10);
        assert_eq!(m.temperature_c.is_nan(), m.sequence <= 5);
        assert!(m.temperature_c.is_nan() || (m.temperature_c - r.temperature_c() as f32).abs() < 1e-6);
    }
    assert!(samples.is_sorted_by(|a, b| a.time_ns < b.time_ns), "times rise");
    for (_, meta, payload) in sink.frames.iter().filter(|f| f.0 == 2) {
        let newest = MotionSample::all_in(payload).last().unwrap();
        assert_eq!((meta.device_sequence, meta.capture_time), (newest.sequence, newest.time()));
        assert_eq!((meta.clock_domain, meta.device_time), (ClockDomain::Device, newest.device_time));
        assert!(meta.capture_time <= meta.arrival);
    }
}

/// Samples that the full queue has no room for are counted as lost here.
#[test]
fn a_full_queue_costs_complete_batches_that_are_counted() {
    const SENT: u64 = 1024 + 40;
    let (mut s, unit) = with_unit(Vec::new(), 0..SENT);
    s.images = Some(Box::new(Silent));
    let mut sink = MemorySink::default();
    s.poll(Duration::ZERO, &mut sink).unwrap();
    assert_eq!(motion_of(&sink, 2).len(), 1024);
    assert_eq!(sink.drops_of(2).total(), 0, "not known before the next sample reports it");
    for n in SENT..SENT + 16 {
        unit.send(record(n)).unwrap();
    }
    let until = HostTime::now().plus(Duration::from_secs(20));
    while motion_of(&sink, 2).len() < 1040 {
        assert!(!until.from_now().is_zero(), "the last batch does not come");
        s.poll(Duration::from_millis(5), &mut sink).unwrap();
    }
    // 40 samples are two batches and a half.
    assert_eq!(sink.drops_of(2).get(DropReason::QueueFull), 3);
    assert_eq!(sink.drops_of(2).total(), 3);
    assert_eq!(sink.captured[2], sink.delivered(2) + 3);
    let samples = motion_of(&sink, 2);
    assert_eq!((samples[1023].sequence, samples[1024].sequence), (1024, SENT + 1));
    assert_eq!(s.motion().unwrap().tally().overflowed, 40);
}

/// Images that do not come.
struct Silent;

impl ImageSource for Silent {
    fn poll(&mut self, timeout: Duration, _: &mut dyn FnMut(&Image<'_>)) -> Result<bool> {
        std::thread::sleep(timeout);
        Ok(false)
    }
}

#[test]
fn a_unit_that_is_gone_ends_no_images_but_a_camera_of_nothing_else() {
    let (mut s, unit) = with_unit(vec![FakeImage::new(1)], 0..3);
    drop(unit);
    let until = HostTime::now().plus(Duration::from_secs(20));
    while s.motion().unwrap().problem().is_none() {
        assert!(!until.from_now().is_zero());
        std::thread::sleep(Duration::from_millis(1));
    }
    let mut sink = MemorySink::default();
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame);
    assert_eq!((sink.delivered(0), sink.delivered(1)), (1, 1));
    s.images = Some(Box::new(Silent));
    assert_eq!(s.poll(Duration::from_millis(150), &mut sink).unwrap(), Poll::Frame, "the last three samples");
    assert_eq!(motion_of(&sink, 2).len(), 3);
    assert_eq!(s.poll(Duration::from_millis(5), &mut sink).unwrap(), Poll::Idle);

    let (send, records) = sync_channel(64);
    (0..16).for_each(|n| send.send(record(n)).unwrap());
    let (motion, samples) = Motion::start_streaming(Box::new(Unit(records)), "ZED 2i 7").unwrap();
    let alone = ZedStream::without_images("ZED 2i 7 at USB port 1-1".to_owned(), motion);
    let mut alone = alone.with_imu(imu::profile().unwrap(), samples);
    assert_eq!(alone.profiles().len(), 1);
    let mut sink = MemorySink::default();
    while sink.delivered(0) == 0 {
        alone.poll(Duration::from_millis(20), &mut sink).unwrap();
    }
    assert_eq!(motion_of(&sink, 0).len(), 16);
    drop(send);
    let gone = loop {
        match alone.poll(Duration::from_millis(20), &mut sink) {
            Err(e) => break e,
            Ok(_) => assert!(!until.from_now().is_zero()),
        }
    };
    assert_eq!(gone.kind(), ErrorKind::Disconnected);
    assert!(gone.to_string().contains("its IMU is no longer read: pulled"), "{gone}");
}
