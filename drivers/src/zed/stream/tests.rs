use super::*;
use crate::v4l2::{FourCc, Interval, Mode};
use crate::zed::profiles::profiles;
use crate::{ErrorKind, MemorySink};
use depthrig_bus::{ClockDomain, DropReason, HostTime};
use std::sync::mpsc::sync_channel;

/// Pictures of 8x3 pixels of both eyes, with two bytes between rows.
const STRIDE: usize = 18;
const ROWS: usize = 3;

struct Made {
    sequence: u64,
    bytes: Vec<u8>,
    damaged: bool,
    kernel: Option<i64>,
}

impl Made {
    fn new(sequence: u64) -> Self {
        let bytes = (0..STRIDE * ROWS).map(|i| (i as u8) ^ (sequence as u8).wrapping_mul(0x55)).collect();
        let now = HostTime::now().ns();
        Self { sequence, bytes, damaged: false, kernel: Some(now - 5_000_000 + sequence as i64) }
    }

    fn eye(&self, eye: Eye) -> Vec<u8> {
        let begin = if eye == Eye::Left { 0 } else { 8 };
        (0..ROWS).flat_map(|y| self.bytes[y * STRIDE + begin..][..8].to_vec()).collect()
    }
}

struct Pictures(Vec<Made>);

impl PictureSource for Pictures {
    fn poll(&mut self, _: Duration, each: &mut dyn FnMut(&Picture<'_>)) -> Result<bool> {
        if self.0.is_empty() {
            return Err(Error::new(ErrorKind::Disconnected, "unplugged"));
        }
        for m in self.0.drain(..) {
            each(&Picture {
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

fn stream(eyes: &[Eye], made: Vec<Made>, settled: Option<Receiver<Result<()>>>) -> ZedStream {
    let mode = Mode {
        format: FourCc(*b"YUYV"),
        width: 8,
        height: ROWS as u32,
        interval: Interval { numerator: 1, denominator: 30 },
    };
    let all = profiles("ZED", &[mode], None).unwrap();
    let chosen = eyes.iter().map(|e| (*e, all[usize::from(*e == Eye::Right)].clone())).collect();
    ZedStream::new(
        "ZED 2i 7 at USB port 1-1".to_owned(),
        chosen,
        Box::new(Pictures(made)),
        STRIDE,
        None,
        settled,
    )
}

#[test]
fn each_eye_gets_its_half_once_with_the_kernels_time() {
    let made = || [7, 8, 9].map(Made::new);
    let (mut sink, source) = (MemorySink::default(), made());
    let times: Vec<_> = source.iter().map(|m| m.kernel.unwrap()).collect();
    let before = crate::unpack::copied_bytes();
    let mut s = stream(&Eye::BOTH, source.into(), None);
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame);
    assert!(crate::unpack::copied_bytes() - before >= 3 * 16 * ROWS as u64);
    assert_eq!(sink.frames.len(), 6);
    for (n, want) in made().iter().enumerate() {
        for (i, eye) in Eye::BOTH.into_iter().enumerate() {
            let (stream, meta, pixels) = &sink.frames[2 * n + i];
            assert_eq!((*stream, pixels), (i, &want.eye(eye)));
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
fn one_eye_alone_is_the_first_stream() {
    let mut sink = MemorySink::default();
    let mut s = stream(&[Eye::Right], vec![Made::new(3)], None);
    assert_eq!(s.profiles()[0].stream.as_str(), "right");
    s.poll(Duration::ZERO, &mut sink).unwrap();
    assert_eq!((sink.frames.len(), sink.frames[0].0), (1, 0));
    assert_eq!(sink.frames[0].2, Made::new(3).eye(Eye::Right));
}

/// Every picture that is not whole costs each eye one frame, with its reason.
#[test]
fn pictures_that_are_not_whole_are_counted_for_both_eyes() {
    let cut = |sequence, bytes: usize| {
        let mut m = Made::new(sequence);
        m.bytes.resize(bytes, 0);
        m
    };
    let damaged = Made { damaged: true, ..Made::new(2) };
    let whole = STRIDE * ROWS;
    // Number 6 never comes.
    let made = vec![
        Made::new(1),
        damaged,
        cut(3, whole - 1),
        cut(4, whole + 1),
        cut(5, 0),
        cut(7, 1),
        Made::new(8),
        Made::new(8),
    ];
    let mut sink = MemorySink::default();
    let mut s = stream(&Eye::BOTH, made, None);
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
    let mut s = stream(&Eye::BOTH, vec![Made::new(1)], None);
    s.poll(Duration::ZERO, &mut sink).unwrap();
    assert_eq!(sink.drops_of(0).get(DropReason::NoSlot), 1);
    assert_eq!((sink.delivered(0), sink.delivered(1)), (0, 1));
}

#[test]
fn a_camera_that_cannot_be_set_ends_the_stream_with_the_reason() {
    let (send, receive) = sync_channel(1);
    let mut s = stream(&Eye::BOTH, vec![Made::new(1)], Some(receive));
    let mut sink = MemorySink::default();
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame, "nothing is known yet");
    send.send(Err(Error::new(ErrorKind::Protocol, "does not take the gain"))).unwrap();
    assert!(s.poll(Duration::ZERO, &mut sink).unwrap_err().to_string().contains("does not take the gain"));
    let (send, receive) = sync_channel(1);
    let mut s = stream(&Eye::BOTH, vec![Made::new(1)], Some(receive));
    send.send(Ok(())).unwrap();
    assert_eq!(s.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame);
}

#[test]
fn sizes_are_told_apart() {
    // Whole, too long, nothing, and what is short of a whole one whatever it rounds to.
    let sizes = [100, 101, 0, 99, 98, 1].map(|came| own_bytes(came, 100, 50));
    assert_eq!(sizes, [50, 51, 0, 49, 49, 1]);
    // Rows with much padding: half of what came could be more than an eye has.
    assert_eq!(own_bytes(199, 200, 50), 49);
}
