#![allow(clippy::unwrap_used)]

use super::*;
use depthrig_bus::{SignalDescription, SignalPublisher, Stamp};

const NAME: &str = "arm/position";

struct Robot {
    signals: Signals,
    feed: SignalFeed,
    dir: tempfile::TempDir,
}

fn robot() -> Robot {
    let dir = tempfile::tempdir().unwrap();
    let runtime = RuntimeDir::at(dir.path()).unwrap();
    Robot { signals: Signals::open(&runtime).unwrap(), feed: SignalFeed::new(runtime), dir }
}

impl Robot {
    fn publisher(&self) -> SignalPublisher {
        let arm = SignalDescription::joints(NAME.parse().unwrap(), &["shoulder", "elbow"], "rad").unwrap();
        self.signals.publisher(&arm).unwrap()
    }

    fn subscribers(&self) -> usize {
        let state = lock(&self.feed.shared.state);
        state.sources.values().filter(|s| s.subscriber.is_some()).count()
    }
}

fn shown(after: u64) -> Vec<Shown> {
    vec![Shown { signal: NAME.into(), after }]
}

/// Publishes a sample of each time, in milliseconds after the first.
fn publish(publisher: &mut SignalPublisher, first: HostTime, times_ms: &[i64]) {
    for ms in times_ms {
        // The time of a replay may be any.
        let stamp = Stamp { flags: SignalFlags::REPLAYED, ..Stamp::at(first.plus_ns(ms * 1_000_000)) };
        publisher.publish_at(&stamp, [*ms as f64, -1.0].map(Value::F64)).unwrap();
    }
}

#[test]
fn a_channel_is_open_only_while_a_page_shows_its_signal_and_once_for_all() {
    let robot = robot();
    let mut publisher = robot.publisher();
    let (one, two) = (robot.feed.enter(), robot.feed.enter());
    assert!(lock(&robot.feed.shared.state).signals.is_none(), "nobody shows a signal");
    assert_eq!(one.show(&[]).unwrap(), News { published: vec![NAME.into()], signals: Vec::new() });
    assert_eq!(robot.subscribers(), 0);
    one.show(&shown(0)).unwrap();
    publisher.publish([0.5, 1.0]).unwrap();
    for page in [&one, &two] {
        let news = page.show(&shown(0)).unwrap();
        assert_eq!(news.published, [NAME]);
        assert_eq!(news.signals[0].values, [[Element::F64(0.5)], [Element::F64(1.0)]]);
        assert_eq!(robot.subscribers(), 1);
    }
    one.leave();
    assert_eq!(robot.subscribers(), 1);
    drop(two);
    assert_eq!(robot.subscribers(), 0);
    assert!(lock(&robot.feed.shared.state).signals.is_none());
}

#[test]
fn an_answer_has_what_the_page_lacks_thinned_to_the_last_of_each_moment() {
    let robot = robot();
    let mut publisher = robot.publisher();
    let page = robot.feed.enter();
    page.show(&shown(0)).unwrap();
    // Times on a grid of the thinning, well in the past.
    let first = HostTime::from_ns((HostTime::now().ns() / POINT_NS - 200) * POINT_NS);
    publish(&mut publisher, first, &[0, 10, 49, 50, 60, 100]);
    let news = page.show(&shown(0)).unwrap().signals.remove(0);
    let plotted: Vec<_> = news.points.iter().map(|p| (p.values[0], p.gap)).collect();
    assert_eq!(plotted, [(49.0, false), (60.0, false), (100.0, false)]);
    let after = news.points[1].number;
    publish(&mut publisher, first, &[160]);
    let news = page.show(&shown(after)).unwrap().signals.remove(0);
    assert_eq!(news.points.iter().map(|p| p.values[0]).collect::<Vec<_>>(), [100.0, 160.0]);
    let after = news.points[1].number;
    assert_eq!(page.show(&shown(after)).unwrap().signals[0].points, []);
}

#[test]
fn what_a_page_did_not_ask_for_in_time_is_a_gap_and_the_newest_stays() {
    let robot = robot();
    let mut publisher = robot.publisher();
    let page = robot.feed.enter();
    page.show(&shown(0)).unwrap();
    let first = HostTime::from_ns((HostTime::now().ns() / POINT_NS - 4000) * POINT_NS);
    let times: Vec<i64> = (0..700).map(|i| i * 50).collect();
    publish(&mut publisher, first, &times);
    let news = page.show(&shown(0)).unwrap().signals.remove(0);
    assert_eq!(news.points.len(), MAX_POINTS);
    assert_eq!(news.points.last().unwrap().values[0], 699.0 * 50.0);
    // 512 of the 700 wait for a reader. The gap lies before those that are kept.
    assert_eq!(news.points.iter().filter(|p| p.gap).count(), 0);
    publish(&mut publisher, first, &(700..1300).map(|i| i * 50).collect::<Vec<_>>());
    let news = page.show(&shown(0)).unwrap().signals.remove(0);
    assert_eq!(news.points.last().unwrap().values[0], 1299.0 * 50.0);
    drop(publisher);
    let mut publisher = robot.publisher();
    publish(&mut publisher, first, &[70_000]);
    let news = page.show(&shown(0)).unwrap().signals.remove(0);
    let last = news.points.last().unwrap();
    assert_eq!((last.gap, last.values[0], news.restarts), (true, 70_000.0, 1));
}

#[test]
fn values_keep_their_types_and_their_number_is_bounded() {
    let robot = robot();
    let field = |name: &str, kind, count| SignalField::new(name, kind, "").with_count(count);
    let fields = vec![
        field("wide", FieldType::F32, 60),
        field("many", FieldType::I64, 8),
        field("closed", FieldType::Bool, 1),
        field("phase", FieldType::Text, 1),
    ];
    let description = SignalDescription::fields(NAME.parse().unwrap(), fields).unwrap();
    let mut publisher = robot.signals.publisher(&description).unwrap();
    let text = "\"quotes\"\nand 🤖";
    let wide = core::iter::repeat_n(Value::F32(f32::NAN), 60);
    let many = [i64::MAX, -7, 0, 0, 0, 0, 0, 0].map(Value::I64);
    let page = robot.feed.enter();
    page.show(&shown(0)).unwrap();
    publisher.publish(wide.chain(many).chain([Value::Bool(true), Value::Text(text)])).unwrap();
    let news = page.show(&shown(0)).unwrap().signals.remove(0);
    assert_eq!(news.values.iter().map(Vec::len).collect::<Vec<_>>(), [60, 4, 0, 0]);
    assert_eq!(news.values[1][..2], [Element::Text(i64::MAX.to_string()), Element::I64(-7)]);
    assert_eq!(news.points[0].values.len(), MAX_LINES);
    let json = serde_json::to_value(&news).unwrap();
    assert_eq!(json["values"][0][0], serde_json::Value::Null);
    assert_eq!(json["fields"][3]["type"], "text");
}

#[test]
fn a_request_that_makes_no_sense_is_refused_and_changes_nothing() {
    let robot = robot();
    let mut publisher = robot.publisher();
    let page = robot.feed.enter();
    page.show(&shown(0)).unwrap();
    publisher.publish([0.0, 0.0]).unwrap();
    let named = |name: &str| Shown { signal: name.into(), after: 0 };
    for wrong in [vec![named("arm")], vec![named("../x/y")], vec![named(NAME); MAX_SHOWN + 1]] {
        assert_eq!(page.show(&wrong).unwrap_err().kind(), ErrorKind::BadInput);
    }
    assert_eq!(robot.subscribers(), 1);
    let unknown = page.show(&[named("leg/x")]).unwrap().signals.remove(0);
    assert_eq!((unknown.problem, unknown.fields.len(), unknown.age_s), (None, 0, None));
    assert_eq!(robot.subscribers(), 0);
    assert!(robot.dir.path().exists());
}
