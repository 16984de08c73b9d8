//! Sums over the batches of an IMU.

use crate::dataset::MotionCount;
use crate::report::MotionReport;
use crate::report::series::{TimeBins, Values};
use crate::{MotionRecord, RecordMotion, StreamAccount};

pub(super) struct Unit {
    pub(super) count: MotionCount,
    gyro: Values,
    accel: Values,
}

impl Unit {
    pub(super) fn new(bins: TimeBins) -> Self {
        Self { count: MotionCount::default(), gyro: Values::new(bins), accel: Values::new(bins) }
    }

    /// Adds a batch, which is counted already; `offset_ns` added to a time of its samples is the time since the first set.
    pub(super) fn batch(&mut self, bins: TimeBins, offset_ns: i64, batch: &RecordMotion) {
        for s in &batch.samples {
            let at = s.time_ns.saturating_add(offset_ns);
            for (values, three) in [(&mut self.gyro, s.gyro_rad_s), (&mut self.accel, s.accel_m_s2)] {
                let length = three.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
                if length.is_finite() {
                    values.add(bins, at, length);
                }
            }
        }
    }

    pub(super) fn report(self, record: MotionRecord, account: Option<StreamAccount>) -> MotionReport {
        MotionReport {
            record,
            batches: self.count.batches,
            lost_batches: self.count.lost_batches,
            samples: self.count.samples,
            never_given: self.count.never_given,
            samples_hz: self.count.rate_hz(),
            rotation_series: self.gyro.ranges(),
            acceleration_series: self.accel.ranges(),
            account,
        }
    }
}
