//! Metric families with the values that one scrape shows, and their encoding by `prometheus-client`.

use core::fmt;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, MetricEncoder, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::{self, Registry};

/// The unit of a metric: the last part of its name.
#[derive(Debug, Clone, Copy)]
pub(super) enum Unit {
    None,
    Seconds,
    Bytes,
    Hertz,
    Ratio,
    Cores,
}

impl Unit {
    fn for_registry(self) -> Option<registry::Unit> {
        match self {
            Self::None => None,
            Self::Seconds => Some(registry::Unit::Seconds),
            Self::Bytes => Some(registry::Unit::Bytes),
            Self::Hertz => Some(registry::Unit::Other("hertz".into())),
            Self::Ratio => Some(registry::Unit::Other("ratio".into())),
            Self::Cores => Some(registry::Unit::Other("cores".into())),
        }
    }
}

/// Labels with their values.
#[derive(Debug, Clone, Default)]
pub(super) struct Labels(Vec<(&'static str, String)>);

impl Labels {
    pub(super) fn new(labels: &[(&'static str, &str)]) -> Self {
        labels.iter().fold(Self::default(), |all, (name, value)| all.with(name, value))
    }

    /// These and one more.
    pub(super) fn with(&self, name: &'static str, value: &str) -> Self {
        let mut all = self.clone();
        all.0.push((name, value.to_owned()));
        all
    }
}

#[derive(Debug, Clone, Copy)]
enum Value {
    Counter(u64),
    Gauge(f64),
}

#[derive(Debug)]
struct Family {
    name: &'static str,
    help: &'static str,
    unit: Unit,
    is_counter: bool,
    samples: Vec<(Labels, Value)>,
}

/// All families, in the order of their first sample: a family's samples must stand together in the text, but the
/// status is walked camera by camera.
#[derive(Debug, Default)]
pub(super) struct Families(Vec<Family>);

impl Families {
    pub(super) fn gauge(
        &mut self,
        name: &'static str,
        help: &'static str,
        unit: Unit,
        labels: &Labels,
        value: f64,
    ) {
        self.family(name, help, unit, false).samples.push((labels.clone(), Value::Gauge(value)));
    }

    /// A counter; `_total` is added to its name.
    pub(super) fn counter(
        &mut self,
        name: &'static str,
        help: &'static str,
        unit: Unit,
        labels: &Labels,
        value: u64,
    ) {
        self.family(name, help, unit, true).samples.push((labels.clone(), Value::Counter(value)));
    }

    /// A counter that may have no sample yet.
    pub(super) fn declare_counter(&mut self, name: &'static str, help: &'static str, unit: Unit) {
        self.family(name, help, unit, true);
    }

    fn family(
        &mut self,
        name: &'static str,
        help: &'static str,
        unit: Unit,
        is_counter: bool,
    ) -> &mut Family {
        let at = self.0.iter().position(|f| f.name == name).unwrap_or_else(|| {
            self.0.push(Family { name, help, unit, is_counter, samples: Vec::new() });
            self.0.len() - 1
        });
        &mut self.0[at]
    }

    pub(super) fn into_text(self) -> String {
        let mut registry = Registry::with_prefix("depthrig");
        registry.register_collector(Box::new(self));
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = text::encode(&mut text, &registry);
        text
    }
}

impl Collector for Families {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        for f in &self.0 {
            let unit = f.unit.for_registry();
            let kind = if f.is_counter { MetricType::Counter } else { MetricType::Gauge };
            let mut metric = encoder.encode_descriptor(f.name, f.help, unit.as_ref(), kind)?;
            match f.samples.as_slice() {
                [(Labels(labels), value)] if labels.is_empty() => value.encode_into(metric)?,
                samples => {
                    for (Labels(labels), value) in samples {
                        value.encode_into(metric.encode_family(labels)?)?;
                    }
                }
            }
        }
        Ok(())
    }
}

impl Value {
    fn encode_into(self, metric: MetricEncoder<'_>) -> fmt::Result {
        match self {
            Self::Counter(n) => ConstCounter::new(n).encode(metric),
            Self::Gauge(x) => ConstGauge::new(x).encode(metric),
        }
    }
}
