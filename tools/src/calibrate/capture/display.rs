//! Progress of a capture on the terminal: a page that is redrawn, or plain lines.

use depthrig_calibrate::capture::{CameraProgress, Progress, State};

/// Columns of one camera's block.
const BLOCK: usize = 26;
/// Missing things that are listed.
const LISTED: usize = 8;

/// The state in words.
pub const fn state(state: State) -> &'static str {
    match state {
        State::Searching => "show the board",
        State::Moving => "the board moves",
        State::HoldStill => "hold still",
        State::Known => "taken here already; move the board",
        State::Unusable => "too little of the board is seen; move it",
        State::Taken => "taken; move the board",
    }
}

/// The page, at most `width` columns wide.
pub fn page(progress: &Progress, out: &str, note: Option<&str>, width: usize) -> String {
    let mut lines = vec![
        format!("{:<40} {} in {out}", state(progress.state).to_uppercase(), views(progress.views)),
        String::new(),
    ];
    let across = (width / BLOCK).max(1);
    for row in progress.cameras.chunks(across) {
        let blocks: Vec<Vec<String>> = row.iter().map(block).collect();
        let height = blocks.iter().map(Vec::len).max().unwrap_or(0);
        for i in 0..height {
            let cells = blocks.iter().map(|b| format!("{:<BLOCK$}", b.get(i).map_or("", String::as_str)));
            lines.push(cells.collect::<String>().trim_end().to_owned());
        }
        lines.push(String::new());
    }
    if !progress.pairs.is_empty() {
        let pair = |p: &depthrig_calibrate::capture::PairProgress| {
            let needed = if p.missing > 0 { format!(" (+{} needed)", p.missing) } else { String::new() };
            format!("{}+{} {}{needed}", p.a, p.b, p.shared)
        };
        let pairs: Vec<String> = progress.pairs.iter().map(pair).collect();
        lines.push(format!("together: {}", pairs.join(", ")));
    }
    if let Some(hint) = &progress.hint {
        lines.push(format!("next:     {}", hint.text));
    }
    lines.extend(missing(progress));
    lines.extend(note.map(|n| format!("note:     {n}")));
    lines.push("Ctrl-C ends; the same command goes on later".to_owned());
    lines.join("\n")
}

/// Missing things, one line each.
pub fn missing(progress: &Progress) -> Vec<String> {
    let mut lines: Vec<String> =
        progress.missing.iter().take(LISTED).map(|m| format!("missing:  {m}")).collect();
    if progress.missing.len() > LISTED {
        lines.push(format!("missing:  and {} more", progress.missing.len() - LISTED));
    }
    lines
}

fn views(n: usize) -> String {
    crate::out::count(n, "view")
}

/// One camera: its name, what it sees, and where its views lie, two rows of cells a line.
fn block(camera: &CameraProgress) -> Vec<String> {
    let sees = if camera.corners > 0 { format!("{} corners", camera.corners) } else { "-".to_owned() };
    let worst = camera.worst_px.map_or_else(String::new, |w| format!(", ±{w:.1} px"));
    let mut lines = vec![format!("{} {sees}", camera.name), format!("{}{worst}", views(camera.views))];
    let columns = camera.coverage_columns.max(1);
    let rows = camera.coverage.len() / columns;
    let now = cells_now(camera, columns, rows);
    for row in (0..rows).step_by(2) {
        let mut line = String::from("|");
        for column in 0..columns {
            let at = |row: usize| row * columns + column;
            let has = |i: usize| camera.coverage.get(i).is_some_and(|n| *n > 0);
            let is_now = |i: usize| now.get(i).copied().unwrap_or(false);
            line.push(match (has(at(row)), has(at(row + 1))) {
                _ if is_now(at(row)) || is_now(at(row + 1)) => 'o',
                (true, true) => '█',
                (true, false) => '▀',
                (false, true) => '▄',
                (false, false) => ' ',
            });
        }
        line.push('|');
        lines.push(line);
    }
    lines
}

/// Cells in which the camera sees corners now.
fn cells_now(camera: &CameraProgress, columns: usize, rows: usize) -> Vec<bool> {
    let mut cells = vec![false; columns * rows];
    for at in &camera.at {
        let cell = |share: f32, n: usize| ((share * n as f32).max(0.0) as usize).min(n.saturating_sub(1));
        if let Some(cell) = cells.get_mut(cell(at[1], rows) * columns + cell(at[0], columns)) {
            *cell = true;
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(name: &str) -> CameraProgress {
        let mut coverage = vec![0; 48];
        coverage[0] = 3;
        coverage[8] = 1;
        coverage[9] = 2;
        CameraProgress {
            name: name.to_owned(),
            corners: 12,
            at: vec![[0.99, 0.99]],
            views: 2,
            coverage,
            coverage_columns: 8,
            worst_px: Some(2.25),
            missing: Vec::new(),
        }
    }

    #[test]
    fn a_page_shows_what_each_camera_has_and_sees() {
        let progress = Progress {
            state: State::HoldStill,
            views: 2,
            cameras: vec![camera("front"), camera("left")],
            pairs: Vec::new(),
            missing: vec!["front: 2 of 10 views".to_owned()],
            hint: None,
        };
        let page = page(&progress, "views", None, 80);
        assert!(page.starts_with("HOLD STILL"), "{page}");
        assert!(page.contains("2 views in views"), "{page}");
        assert!(page.contains("|█▄      |                |█▄      |"), "{page}");
        assert!(page.contains("|       o|"), "{page}");
        assert!(page.contains("2 views, ±2.2 px"), "{page}");
        assert!(page.contains("missing:  front: 2 of 10 views"), "{page}");
        // In a narrow terminal the cameras are below each other.
        assert!(
            super::page(&progress, "views", None, 30)
                .lines()
                .all(|l| !l.contains("front") || !l.contains("left"))
        );
    }
}
