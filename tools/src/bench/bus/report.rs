//! The result of the bus benchmark as text, checked against the promises.

use super::{BusReport, Disturbed};
use crate::bench::stats::Quantiles;
use crate::out;

/// Publish-to-receive median over that of a bare loop.
const LATENCY_BAR: f64 = 1.15;
/// CPU of publishing over that of bare copies.
const CPU_BAR: f64 = 1.3;
/// Change of the publisher's 99th percentile by bad subscribers.
const DISTURBANCE_BAR: f64 = 1.1;

/// One promise with its measured value.
pub struct Bar {
    /// Text of the promise.
    pub promise: &'static str,
    /// Measured value.
    pub measured: String,
    /// Whether the promise is kept.
    pub kept: bool,
}

impl Bar {
    /// Formats the promise on one line.
    pub fn line(&self) -> String {
        let word = if self.kept { "ok    " } else { "MISSED" };
        format!("  {word} {}: measured {}", self.promise, self.measured)
    }
}

/// Checks every promise.
pub fn bars(report: &BusReport) -> Vec<Bar> {
    let below =
        |promise, value: f64, bar: f64| Bar { promise, measured: format!("{value:.3}"), kept: value <= bar };
    let copies = report.copies.count();
    vec![
        below(
            "publish to receive, p50 over a bare iceoryx2 loop: at most 1.15",
            report.latency.ratio_p50,
            LATENCY_BAR,
        ),
        Bar {
            promise: "copies of the pixels from driver to subscriber: exactly 1",
            measured: format!("{copies:.3}"),
            kept: copies == 1.0,
        },
        Bar {
            promise: "seven cameras, frames lost: 0",
            measured: format!("{} of {}", report.load.lost, report.load.sent),
            kept: report.load.lost == 0,
        },
        below("seven cameras, CPU over bare memory copies: at most 1.3", report.load.cpu_ratio, CPU_BAR),
        below(
            "publisher p99 beside a subscriber that holds frames: below 1.10",
            report.load.holding.p99_ratio,
            DISTURBANCE_BAR,
        ),
        below(
            "publisher p99 beside a subscriber that is killed: below 1.10",
            report.load.killed.p99_ratio,
            DISTURBANCE_BAR,
        ),
    ]
}

/// Formats tables and promises.
pub fn text(report: &BusReport) -> String {
    let l = &report.latency;
    let mib = l.frame_bytes as f64 / f64::from(1 << 20);
    let row = |name: &str, q: &Quantiles| {
        vec![
            name.to_owned(),
            q.n.to_string(),
            format!("{:.1}", q.p50_us),
            format!("{:.1}", q.p99_us),
            format!("{:.1}", q.max_us),
        ]
    };
    let latency = out::table(
        &["microseconds", "frames", "p50", "p99", "max"],
        1,
        [
            row("publish to receive, depthrig", &l.ours),
            row("publish to receive, bare iceoryx2", &l.bare),
            row("with loan and write, depthrig", &l.ours_total),
            row("with loan and write, bare iceoryx2", &l.bare_total),
        ],
    );
    let disturbed = |name: &str, d: &Disturbed| {
        let mut row = row(name, &d.wall);
        row.extend([
            format!("{:.3}", d.p99_ratio),
            format!("{:.3}", d.p99_ratio_of_rounds),
            format!("{:.1}", d.cpu.p99_us),
            format!("{:.3}", d.cpu_p99_ratio),
        ]);
        row
    };
    let load = &report.load;
    let publisher = out::table(
        &["microseconds", "pairs", "p50", "p99", "max", "p99 ratio", "of rounds", "CPU p99", "CPU p99 ratio"],
        1,
        [
            disturbed("one good subscriber", &load.normal),
            disturbed("and one that holds 16 frames", &load.holding),
            disturbed(&format!("and one killed {} times", load.kills), &load.killed),
        ],
    );
    let list = |values: &[f64]| values.iter().map(|v| format!("{v:.3}")).collect::<Vec<_>>().join(" ");
    let promises: Vec<String> = bars(report).iter().map(Bar::line).collect();
    format!(
        "{conditions}\n\n\
         One stream of {mib:.1} MiB at 30 Hz, two processes, blocking wait; blocks of 30 frames alternate\n{latency}\n\
         ratio of p50 {ratio:.3}; median over neighbouring blocks {blocks:.3}\n\n\
         Copies: {in_place} of {frames} frames were read at the file and offset of shared memory where they were \
         written; {writes:.2} bytes written per byte published\n\n\
         Seven cameras x 1280x720 (RGB8 + Z16) x 30 Hz, {slots} slots a stream: {sent} frames sent, {lost} lost\n\
         publishing process, cores a round:        {publish}\n\
         bare copies at the same rate, a round:    {copy}\n\
         ratio (median of the rounds)              {cpu_ratio:.3}\n\n\
         Loan, write and send of one camera's two frames, by what else subscribes\n{publisher}\n\n\
         Promises\n{promises}",
        conditions = report.conditions.line(),
        ratio = l.ratio_p50,
        blocks = l.ratio_p50_of_blocks,
        in_place = report.copies.in_place,
        frames = report.copies.frames,
        writes = report.copies.writes_per_byte,
        slots = load.slots,
        sent = load.sent,
        lost = load.lost,
        publish = list(&load.publish_cores),
        copy = list(&load.copy_cores),
        cpu_ratio = load.cpu_ratio,
        promises = promises.join("\n"),
    )
}
