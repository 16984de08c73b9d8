//! Facts of streams, vectors and episodes that arrays have no place for, as JSON.

use super::plan::Plan;
use super::schema::{Schema, calibration};
use crate::Source;
use serde_json::{Value, json};

/// The facts of an export as the layout named `format` has them; `name_of` is its name for a vector. The streams are as in the first dataset;
/// an episode whose calibration differs has its own.
pub(crate) fn attributes(
    plan: &Plan,
    sources: &[Source],
    format: &str,
    name_of: &dyn Fn(&'static str) -> &'static str,
) -> Value {
    let first = sources.first().map(|source| streams(&plan.schema, source)).unwrap_or_default();
    let vectors = plan.schema.vectors.iter().map(|v| json!({ "array": name_of(v.key), "names": v.names() }));
    let episodes = sources.iter().zip(&plan.episodes).map(|(source, e)| {
        let mut entry = json!({
            "session": source.session().name,
            "task": plan.tasks[e.task],
            "success": e.is_success,
            "episode": source.episode(),
        });
        let streams = streams(&plan.schema, source);
        if streams != first {
            entry["streams"] = json!(streams);
        }
        entry
    });
    json!({
        "format": format,
        "rate_hz": plan.fps,
        "vectors": vectors.collect::<Vec<_>>(),
        "interpolation": plan.schema.rule(),
        "episodes": episodes.collect::<Vec<_>>(),
        "streams": first,
    })
}

/// Name, unit and calibration of each stream of a dataset.
fn streams(schema: &Schema, source: &Source) -> Vec<Value> {
    let of = schema.features.iter().filter_map(|feature| {
        let mut entry = json!({ "array": feature.short, "stream": feature.id.to_string() });
        let record = source.session().streams.iter().find(|s| s.id == feature.id)?;
        entry["depth_unit_m"] = json!(record.depth_unit_m);
        for (key, value) in calibration(record) {
            entry[key] = value;
        }
        Some(entry)
    });
    of.collect()
}
