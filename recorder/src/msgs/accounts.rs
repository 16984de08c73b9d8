//! `depthrig_msgs/msg/Accounts`: what was captured, delivered, recorded and lost, in cumulated numbers.

use crate::cdr::{Reader, Writer};
use crate::{Result, SetDrop};
use depthrig_bus::{DropCounts, DropReason, StreamId};
use serde::{Serialize, Serializer};

/// The account of one stream since it began: `captured = delivered + Σ dropped`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct StreamAccount {
    /// The stream.
    pub stream: StreamId,
    /// Frames that the device captured.
    pub captured: u64,
    /// Frames that reached the stream's channel.
    pub delivered: u64,
    /// Frames lost, by reason.
    #[serde(serialize_with = "by_name")]
    pub dropped: DropCounts,
}

fn by_name<S: Serializer>(counts: &DropCounts, s: S) -> Result<S::Ok, S::Error> {
    s.collect_map(counts.nonzero().map(|(r, n)| (r.name(), n)))
}

impl StreamAccount {
    /// Whether `captured = delivered + Σ dropped`.
    pub fn balances(&self) -> bool {
        self.captured == self.delivered.saturating_add(self.dropped.total())
    }
}

/// The account of the sets handed to the recorder: `offered = recorded + Σ dropped`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SetCounts {
    /// Sets handed over.
    pub offered: u64,
    /// Sets that are in the file.
    pub recorded: u64,
    /// Sets lost, indexed by [`SetDrop`].
    pub dropped: [u64; SetDrop::ALL.len()],
}

impl SetCounts {
    /// Sets lost for any reason.
    pub fn dropped_total(&self) -> u64 {
        // The numbers of a damaged file may not fit.
        self.dropped.iter().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// The reasons that lost anything, with their counts.
    pub fn dropped_by_reason(&self) -> impl Iterator<Item = (SetDrop, u64)> + '_ {
        SetDrop::ALL.into_iter().map(|r| (r, self.dropped[r as usize])).filter(|(_, n)| *n > 0)
    }

    /// Whether `offered = recorded + Σ dropped`.
    pub fn balances(&self) -> bool {
        self.offered == self.recorded.saturating_add(self.dropped_total())
    }
}

impl Serialize for SetCounts {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeStruct;
        let mut out = s.serialize_struct("SetCounts", 3)?;
        out.serialize_field("offered", &self.offered)?;
        out.serialize_field("recorded", &self.recorded)?;
        let dropped: std::collections::BTreeMap<_, _> =
            self.dropped_by_reason().map(|(r, n)| (r.name(), n)).collect();
        out.serialize_field("dropped", &dropped)?;
        out.end()
    }
}

pub(crate) fn write(buf: &mut Vec<u8>, stamp_utc_ns: i64, sets: &SetCounts, streams: &[StreamAccount]) {
    let mut w = Writer::new(buf);
    w.time(stamp_utc_ns).u64(sets.offered).u64(sets.recorded).u64s(&sets.dropped);
    w.u32(streams.len() as u32);
    for a in streams {
        w.str(&a.stream.to_string()).u64(a.captured).u64(a.delivered).u64s(&a.dropped.0);
    }
}

pub(crate) fn read(message: &[u8]) -> Result<(SetCounts, Vec<StreamAccount>)> {
    let mut r = Reader::new(message)?;
    r.time()?;
    let sets = SetCounts { offered: r.u64()?, recorded: r.u64()?, dropped: r.array(Reader::u64)? };
    let streams = r.seq(|r| {
        let stream = r.str()?.parse().map_err(|e| {
            crate::Error::new(crate::ErrorKind::Corrupt, "an account names no stream").with_source(e)
        })?;
        Ok(StreamAccount {
            stream,
            captured: r.u64()?,
            delivered: r.u64()?,
            dropped: DropCounts(r.array::<_, { DropReason::ALL.len() }>(Reader::u64)?),
        })
    })?;
    Ok((sets, streams))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let sets = SetCounts { offered: 9, recorded: 5, dropped: [1, 0, 3, 0, 0, 0] };
        let streams = vec![StreamAccount {
            stream: "d435/depth".parse().unwrap(),
            captured: 10,
            delivered: 8,
            dropped: DropCounts([0, 2, 0, 0, 0, 0, 0, 0]),
        }];
        let mut buf = Vec::new();
        write(&mut buf, 5, &sets, &streams);
        assert_eq!(read(&buf).unwrap(), (sets, streams.clone()));
        assert!(sets.balances() && streams[0].balances());
        let json = serde_json::to_string(&(sets, &streams)).unwrap();
        assert!(json.contains(r#""dropped":{"encoder_busy":1,"write_failed":3}"#), "{json}");
    }
}
