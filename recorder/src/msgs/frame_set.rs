//! `depthrig_msgs/msg/FrameSet`: what a set is made of, written after its frames: the set's commit mark.
//! And `ClockPair`, the two clocks of the host side by side.

use crate::Result;
use crate::cdr::{Reader, Writer};
use depthrig_bus::UtcPair;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct FrameSetMsg {
    pub(crate) stamp_utc_ns: i64,
    pub(crate) id: u64,
    pub(crate) tick_ns: i64,
    pub(crate) utc_offset_ns: i64,
    pub(crate) spread_ns: i64,
    pub(crate) sets_offered: u64,
    pub(crate) members: Vec<Member>,
    pub(crate) missing: Vec<String>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Member {
    pub(crate) stream: String,
    pub(crate) sequence: u64,
    pub(crate) capture_time_ns: i64,
    pub(crate) message_bytes: u64,
    pub(crate) message_crc32: u32,
}

impl FrameSetMsg {
    pub(crate) fn write(&self, buf: &mut Vec<u8>) {
        let mut w = Writer::new(buf);
        w.time(self.stamp_utc_ns).u64(self.id).i64(self.tick_ns).i64(self.utc_offset_ns);
        w.i64(self.spread_ns).u64(self.sets_offered).u32(self.members.len() as u32);
        for m in &self.members {
            w.str(&m.stream).u64(m.sequence).i64(m.capture_time_ns).u64(m.message_bytes).u32(m.message_crc32);
        }
        w.u32(self.missing.len() as u32);
        for name in &self.missing {
            w.str(name);
        }
    }

    pub(crate) fn read(message: &[u8]) -> Result<Self> {
        let mut r = Reader::new(message)?;
        Ok(Self {
            stamp_utc_ns: r.time()?,
            id: r.u64()?,
            tick_ns: r.i64()?,
            utc_offset_ns: r.i64()?,
            spread_ns: r.i64()?,
            sets_offered: r.u64()?,
            members: r.seq(|r| {
                Ok(Member {
                    stream: r.str()?.to_owned(),
                    sequence: r.u64()?,
                    capture_time_ns: r.i64()?,
                    message_bytes: r.u64()?,
                    message_crc32: r.u32()?,
                })
            })?,
            missing: r.seq(|r| r.str().map(str::to_owned))?,
        })
    }
}

pub(crate) fn write_clock_pair(buf: &mut Vec<u8>, stamp_utc_ns: i64, pair: &UtcPair) {
    let mut w = Writer::new(buf);
    w.time(stamp_utc_ns).i64(pair.mono.ns()).i64(pair.utc_ns).i64(pair.width_ns);
}

/// `depthrig_msgs/msg/Checkpoint`: the CRC-32 of the first `file_bytes` bytes of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Checkpoint {
    pub(crate) file_bytes: u64,
    pub(crate) crc32: u32,
}

impl Checkpoint {
    pub(crate) fn write(self, buf: &mut Vec<u8>, stamp_utc_ns: i64) {
        Writer::new(buf).time(stamp_utc_ns).u64(self.file_bytes).u32(self.crc32);
    }

    pub(crate) fn read(message: &[u8]) -> Result<Self> {
        let mut r = Reader::new(message)?;
        r.time()?;
        Ok(Self { file_bytes: r.u64()?, crc32: r.u32()? })
    }
}

pub(crate) fn read_clock_pair(message: &[u8]) -> Result<UtcPair> {
    let mut r = Reader::new(message)?;
    r.time()?;
    Ok(UtcPair { mono: depthrig_bus::HostTime::from_ns(r.i64()?), utc_ns: r.i64()?, width_ns: r.i64()? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::HostTime;

    #[test]
    fn what_is_written_is_read() {
        let set = FrameSetMsg {
            stamp_utc_ns: 1_700_000_000_123_456_789,
            id: 7,
            tick_ns: -3,
            utc_offset_ns: 1 << 60,
            spread_ns: 9_000_000,
            sets_offered: 8,
            members: vec![Member {
                stream: "d435/depth".into(),
                sequence: 4,
                capture_time_ns: 5,
                message_bytes: 6,
                message_crc32: u32::MAX,
            }],
            missing: vec!["d405/color".into(), "zed/depth".into()],
        };
        let mut buf = Vec::new();
        set.write(&mut buf);
        assert_eq!(FrameSetMsg::read(&buf).unwrap(), set);
        for cut in 0..buf.len() - 1 {
            assert!(FrameSetMsg::read(&buf[..cut]).is_err(), "cut at {cut}");
        }
        let pair = UtcPair { mono: HostTime::from_ns(5), utc_ns: 6, width_ns: 7 };
        let mut buf = Vec::new();
        write_clock_pair(&mut buf, 1, &pair);
        assert_eq!(read_clock_pair(&buf).unwrap(), pair);
        let checkpoint = Checkpoint { file_bytes: 1 << 40, crc32: 7 };
        let mut buf = Vec::new();
        checkpoint.write(&mut buf, 1);
        assert_eq!(Checkpoint::read(&buf).unwrap(), checkpoint);
    }
}
