//! Sums over the samples of a signal.

use crate::dataset::SignalCount;
use crate::report::series::{TimeBins, Values};
use crate::report::{FieldSeries, SignalReport};
use crate::{SignalRecord, StreamAccount};
use depthrig_bus::{SignalSample, Value};

/// Elements that are plotted: beyond these a plot is unreadable.
const PLOTTED: usize = 16;

pub(super) struct Signal {
    pub(super) count: SignalCount,
    names: Vec<String>,
    values: Vec<Values>,
}

impl Signal {
    pub(super) fn new(bins: TimeBins, record: &SignalRecord) -> Self {
        let mut names = Vec::new();
        for field in record.description.all_fields() {
            match field.count {
                1 => names.push(field.name.clone()),
                n => names.extend((0..n.min(PLOTTED as u32)).map(|i| format!("{}[{i}]", field.name))),
            }
        }
        if record.description.has_text() {
            names.pop();
        }
        names.truncate(PLOTTED);
        let values = names.iter().map(|_| Values::new(bins)).collect();
        Self { count: SignalCount::default(), names, values }
    }

    /// Adds samples, which are counted already; `offset_ns` added to their times is the time since the first set.
    pub(super) fn samples(&mut self, bins: TimeBins, offset_ns: i64, samples: &[SignalSample]) {
        for sample in samples {
            let at = sample.header().time_ns.saturating_add(offset_ns);
            for (values, x) in self.values.iter_mut().zip(sample.values().filter_map(Value::number)) {
                if x.is_finite() {
                    values.add(bins, at, x);
                }
            }
        }
    }

    pub(super) fn report(
        self,
        record: &SignalRecord,
        end_ns: Option<i64>,
        account: Option<StreamAccount>,
    ) -> SignalReport {
        let unit = record.description.all_fields().first().map(|f| f.unit.clone()).unwrap_or_default();
        let series = |(name, values): (String, Values)| FieldSeries { name, series: values.ranges() };
        SignalReport {
            id: record.id.clone(),
            kind: record.description.kind().name(),
            unit,
            samples: self.count.samples,
            lost: self.count.lost,
            restarts: self.count.restarts,
            samples_hz: self.count.rate_hz(),
            remarks: self.count.in_words(&record.id, end_ns),
            fields: self.names.into_iter().zip(self.values).map(series).collect(),
            account,
        }
    }
}
