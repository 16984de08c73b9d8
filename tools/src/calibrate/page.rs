//! The HTML report of a calibration.

use depthrig_calibrate::file::{CalibratedCamera, Calibration};
use depthrig_calibrate::mount::{CameraResult, MountResult, Source};
use depthrig_recorder::report::page::{self, END_TABLE, escape};
use std::fmt::Write as _;

/// Width of a map, pixels of the page.
const MAP_WIDTH: f64 = 300.0;
/// Uncertainty with the strongest colour, pixels.
const STRONG_PX: f64 = 1.0;

/// The report.
pub fn page(file: &Calibration, result: &MountResult, refused: &[String], images: usize) -> String {
    let mut out = page::begin("Calibration – depthrig report");
    let board = &file.board;
    let _ = write!(
        out,
        "<h1>Calibration</h1><p>{} from {} views in {images} images of a board of {}x{} squares of {} mm; reference camera {}.</p>",
        escape(&file.created),
        result.views.len(),
        board.columns,
        board.rows,
        board.square_mm * board.scale(),
        escape(&file.reference)
    );
    advice(&mut out, result, refused, board.measured_ruler_mm.is_none());
    cameras(&mut out, file);
    if file.cameras.len() > 1 {
        poses(&mut out, file);
    }
    intrinsics(&mut out, file);
    for (camera, in_file) in result.cameras.iter().zip(&file.cameras) {
        maps(&mut out, camera, in_file);
    }
    views(&mut out, result);
    page::end(&mut out);
    out
}

fn advice(out: &mut String, result: &MountResult, refused: &[String], no_ruler: bool) {
    out.push_str("<h2>What to do better next time</h2><ul>");
    if no_ruler {
        out.push_str(
            "<li>Measure the board's ruler line and write it into the board's file: if the printer scaled by 1 %, every distance is \
             wrong by 1 %.</li>",
        );
    }
    for line in &result.advice {
        let _ = write!(out, "<li>{}</li>", escape(line));
    }
    if result.advice.is_empty() && !no_ruler {
        out.push_str("<li>Nothing: views, coverage and residuals are good.</li>");
    }
    out.push_str("</ul>");
    if !refused.is_empty() {
        out.push_str("<details><summary>Images that were refused</summary><ul>");
        for line in refused {
            let _ = write!(out, "<li>{}</li>", escape(line));
        }
        out.push_str("</ul></details>");
    }
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.filter(|v| v.is_finite()).map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"))
}

fn cameras(out: &mut String, file: &Calibration) {
    let columns = [
        "camera",
        "intrinsics",
        "#views",
        "#corners",
        "#residual px",
        "#held out px",
        "#factory px",
        "#projection ± px",
        "#halves differ px",
    ];
    out.push_str("<h2>Cameras</h2>");
    page::table(out, &columns);
    for camera in &file.cameras {
        let q = &camera.quality;
        let cells = [
            camera.name.clone(),
            if camera.source == Source::Factory { "factory" } else { "calibrated" }.to_owned(),
            q.views.to_string(),
            q.corners.to_string(),
            number(Some(q.rms_px), 3),
            number(q.held_out_px, 3),
            number(q.factory_px, 3),
            format!(
                "{}..{}",
                number(Some(q.projection_middle_px), 2),
                number(Some(q.projection_worst_px), 2)
            ),
            number(q.halves_differ_px, 2),
        ];
        page::row(out, &columns, &cells);
    }
    out.push_str(END_TABLE);
    out.push_str(
        "<p>Residuals say how well the model fits these corners, not how good the calibration is: that is what the views held out, the \
         uncertainty of projection and the difference between two halves of the views say.</p>",
    );
}

fn poses(out: &mut String, file: &Calibration) {
    let columns = ["camera", "#x mm", "#y mm", "#z mm", "#± mm", "#± deg", "#halves differ mm", "#deg"];
    out.push_str("<h2>Poses on the mount</h2>");
    page::table(out, &columns);
    for camera in &file.cameras {
        // The reference is at 0, not at -0.
        let [x, y, z] = camera.pose.translation_m.map(|t| format!("{:.2}", t * 1e3 + 0.0));
        let cells = [
            camera.name.clone(),
            x,
            y,
            z,
            number(Some(camera.pose.sigma_mm), 3),
            number(Some(camera.pose.sigma_deg), 4),
            number(camera.quality.halves_differ_mm, 3),
            number(camera.quality.halves_differ_deg, 4),
        ];
        page::row(out, &columns, &cells);
    }
    out.push_str(END_TABLE);
}

fn intrinsics(out: &mut String, file: &Calibration) {
    let columns = ["camera", "model", "#fx", "#fy", "#cx", "#cy", "coefficients"];
    out.push_str("<h2>Intrinsics</h2>");
    page::table(out, &columns);
    for camera in &file.cameras {
        let k = &camera.intrinsics;
        let with_sigma = |i: usize, value: f64, digits: usize| match k.sigmas.get(i) {
            Some(sigma) if *sigma > 0.0 => format!("{value:.digits$} ± {sigma:.digits$}"),
            Some(_) => format!("{value:.digits$} (not estimated)"),
            None => format!("{value:.digits$}"),
        };
        let coefficients: Vec<String> =
            k.coeffs.iter().enumerate().map(|(i, c)| with_sigma(4 + i, *c, 5)).collect();
        let cells = [
            camera.name.clone(),
            serde_json::to_value(k.model)
                .ok()
                .and_then(|v| v.as_str().map(str::to_owned))
                .unwrap_or_default(),
            with_sigma(0, k.fx, 3),
            with_sigma(1, k.fy, 3),
            with_sigma(2, k.cx, 3),
            with_sigma(3, k.cy, 3),
            coefficients.join(", "),
        ];
        page::row(out, &columns, &cells);
    }
    out.push_str(END_TABLE);
}

fn maps(out: &mut String, camera: &CameraResult, in_file: &CalibratedCamera) {
    let _ = write!(out, "<h2>{}</h2><div class=\"wide\">", escape(&camera.name));
    let ratio = f64::from(in_file.height) / f64::from(in_file.width);
    let most = camera.coverage.corners.iter().max().copied().unwrap_or(1).max(1);
    let counts: Vec<f64> = camera.coverage.corners.iter().map(|n| f64::from(*n) / f64::from(most)).collect();
    let coverage = Map {
        title: format!(
            "Corners seen: {:.0} % of the image; at most {most} in a cell",
            camera.coverage.share() * 100.0
        ),
        values: &counts,
        labels: camera.coverage.corners.iter().map(ToString::to_string).collect(),
        columns: camera.coverage.columns,
        color: |v| format!("hsl(210 60% {:.0}%)", 96.0 - 50.0 * v),
    };
    coverage.draw(out, ratio);
    let sigma = &camera.uncertainty;
    let uncertainty = Map {
        title: format!(
            "Uncertainty of projection at {:.2} m: {:.2} px in the middle, at most {:.2} px; red is {STRONG_PX} px",
            sigma.distance_m,
            sigma.middle_px(),
            sigma.worst_px()
        ),
        values: &sigma.sigma_px,
        labels: sigma.sigma_px.iter().map(|s| format!("{s:.2}")).collect(),
        columns: sigma.columns,
        color: heat,
    };
    uncertainty.draw(out, ratio);
    let projection = camera.cross_validation.as_ref().and_then(|c| c.projection.as_ref());
    if let Some(p) = projection {
        let difference = Map {
            title: format!(
                "Two halves of the views differ by {:.2} px (mean), {:.2} px (at most); red is {STRONG_PX} px",
                p.mean_px, p.max_px
            ),
            values: &p.grid_px,
            labels: p.grid_px.iter().map(|d| format!("{d:.2}")).collect(),
            columns: p.columns,
            color: heat,
        };
        difference.draw(out, ratio);
    }
    out.push_str("</div>");
}

/// From green to red.
fn heat(value: f64) -> String {
    let share = (value / STRONG_PX).clamp(0.0, 1.0);
    format!("hsl({:.0} 70% 60%)", 130.0 * (1.0 - share))
}

/// Values over an image.
struct Map<'a> {
    title: String,
    values: &'a [f64],
    labels: Vec<String>,
    columns: usize,
    color: fn(f64) -> String,
}

impl Map<'_> {
    fn draw(&self, out: &mut String, ratio: f64) {
        let rows = self.values.len() / self.columns.max(1);
        let cell_width = MAP_WIDTH / self.columns.max(1) as f64;
        let cell_height = MAP_WIDTH * ratio / rows.max(1) as f64;
        let title = escape(&self.title);
        let _ = write!(
            out,
            "<figure style=\"display:inline-block;vertical-align:top;margin:0 16px 16px 0;max-width:{MAP_WIDTH}px\"><svg shape-rendering=\"crispEdges\" role=\"img\" aria-label=\"{title}\" \
             width=\"{MAP_WIDTH}\" height=\"{:.0}\" viewBox=\"0 0 {MAP_WIDTH} {:.2}\" xmlns=\"http://www.w3.org/2000/svg\">",
            MAP_WIDTH * ratio,
            MAP_WIDTH * ratio
        );
        for (i, (value, label)) in self.values.iter().zip(&self.labels).enumerate() {
            let color = if value.is_finite() { (self.color)(*value) } else { "#888".to_owned() };
            let _ = write!(
                out,
                "<rect x=\"{:.2}\" y=\"{:.2}\" width=\"{cell_width:.2}\" height=\"{cell_height:.2}\" fill=\"{color}\"><title>{}</title></rect>",
                (i % self.columns) as f64 * cell_width,
                (i / self.columns) as f64 * cell_height,
                escape(label)
            );
        }
        let _ = write!(out, "</svg><figcaption>{title}</figcaption></figure>");
    }
}

fn views(out: &mut String, result: &MountResult) {
    let mut columns = vec!["view".to_owned()];
    columns.extend(result.cameras.iter().map(|c| format!("#{} px", escape(&c.name))));
    let names: Vec<&str> = columns.iter().map(String::as_str).collect();
    out.push_str("<h2>Residuals of each view</h2>");
    page::table(out, &names);
    for view in &result.views {
        let mut cells = vec![view.name.clone()];
        for camera in 0..result.cameras.len() {
            let seen = view.seen.iter().find(|s| s.camera == camera);
            cells.push(seen.map_or_else(String::new, |s| match s.outliers {
                0 => format!("{:.3}", s.rms_px),
                n => format!("{:.3} ({n} left out)", s.rms_px),
            }));
        }
        page::row(out, &names, &cells);
    }
    out.push_str(END_TABLE);
}
