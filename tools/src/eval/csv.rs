//! The numbers as CSV: a line for each row, of all images and of each distance, material and scene.

use super::summary::{Evaluation, Row};
use super::text::measures;
use depthrig_cdm::metrics::DepthMetrics;

const HEADER: &str = "group,prediction,input,part,of,mean,images,counted,valid,missing_percent,\
    l1_m,rmse_m,abs_rel,delta_05,delta_1,delta_105,delta_110,\
    strict_l1_m,strict_rmse_m,strict_abs_rel,strict_delta_05,strict_delta_1,strict_delta_105,strict_delta_110\n";

/// The file. `part` is `all`, `distance`, `material` or `scene`, `of` which one, and `mean` is over `images` or `pixels`. Numbers
/// have all their digits; a measure over nothing is empty.
pub fn file(evaluation: &Evaluation) -> String {
    let mut out = HEADER.to_owned();
    for r in &evaluation.rows {
        let all = &r.metrics;
        let mut line = |part: &str, of: &str, mean: &str, images: Option<u64>, m: &DepthMetrics| {
            if m.counted > 0 {
                out.push_str(&self::line(r, [part, of, mean], images, m));
            }
        };
        line("all", "", "images", Some(all.images), &all.mean_of_images);
        line("all", "", "pixels", Some(all.images), &all.pixel_pooled);
        for bin in &r.by_distance {
            line("distance", &format!("{}-{}", bin.from_m, bin.to_m), "pixels", None, &bin.metrics);
        }
        for material in &r.by_material {
            line("material", &material.material, "pixels", None, &material.metrics);
        }
        for scene in &r.by_scene {
            let images = Some(scene.metrics.images);
            line("scene", &scene.scene, "images", images, &scene.metrics.mean_of_images);
            line("scene", &scene.scene, "pixels", images, &scene.metrics.pixel_pooled);
        }
    }
    out
}

fn line(r: &Row, part: [&str; 3], images: Option<u64>, m: &DepthMetrics) -> String {
    let number = |v: f64| if v.is_finite() { v.to_string() } else { String::new() };
    let mut cells = vec![quoted(&r.group), quoted(&r.info.name), r.info.input.clone()];
    cells.extend(part.map(quoted));
    cells.push(images.map(|n| n.to_string()).unwrap_or_default());
    cells.extend([m.counted, m.valid].map(|n| n.to_string()));
    cells.push(number(m.missing_percent));
    cells.extend(measures(m, false).map(number));
    cells.extend(measures(m, true).map(number));
    cells.join(",") + "\n"
}

/// A cell as RFC 4180 has it.
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_quoted_where_they_must_be() {
        assert_eq!(quoted("fill"), "fill");
        assert_eq!(quoted("a,\"b\""), "\"a,\"\"b\"\"\"");
    }

    #[test]
    fn the_header_has_a_name_for_each_cell() {
        let names = HEADER.trim_end().split(',').count();
        assert_eq!(names, 10 + 2 * super::super::text::MEASURES.len());
        assert!(!HEADER.contains(' '));
    }
}
