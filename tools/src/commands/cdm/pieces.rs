//! `depthrig cdm relabel --shard`: refined depth for recordings by many machines.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::scratch::{Scratch, path_of};
use crate::watched::{usage, watched};
use anyhow::Result;
use depthrig_convert::RunPart;
use depthrig_convert::relabel::{
    Pieces, PiecesReport, RelabelOptions, RelabelledStream, Step, relabel_pieces,
};
use depthrig_convert::store::Place;
use std::path::Path;

/// A part of the work.
pub struct Request<'a> {
    /// A dataset or a folder of datasets, here or in a bucket.
    pub input: &'a Path,
    /// Folder of the pieces, here or in a bucket.
    pub out: &'a Path,
    /// The part.
    pub part: RunPart,
    /// Folder for copies.
    pub scratch: &'a Scratch,
    /// Whether the report is printed as JSON.
    pub json: bool,
}

/// Makes the pieces of a part and reports them.
pub fn run(request: &Request<'_>, options: &RelabelOptions, context: &Context) -> Result<Exit> {
    let input = Place::parse(request.input).map_err(usage)?;
    let out = Place::parse(request.out).map_err(usage)?;
    let scratch = request.scratch.folder(&[&input, &out])?;
    let pieces = Pieces { input, out, part: request.part, scratch: path_of(scratch.as_ref()) };
    let report = watched(context, |progress| {
        relabel_pieces(&pieces, options, &mut |piece, step, done, total| {
            progress(&format!("{piece}: {}", step_name(step)), done, total)
        })
    })?;
    if request.json {
        out::json(&report)?;
    } else {
        print(&report)?;
    }
    for skipped in &report.skipped {
        let segment = skipped.segment.as_ref().map(|file| format!("/{file}")).unwrap_or_default();
        out::note(format_args!("skipped: {}{segment}: {}", skipped.dataset, skipped.why));
    }
    for problem in &report.problems {
        out::note(format_args!("lost: {problem}"));
    }
    if report.lost > report.problems.len() as u64 {
        out::note(format_args!("lost: {} in all", report.lost));
    }
    if report.pieces_missing > 0 {
        out::note(format_args!("{} pieces are missing; run the same command again", report.pieces_missing));
    }
    let is_complete = report.pieces_missing == 0 && report.skipped.is_empty() && report.lost == 0;
    Ok(if is_complete { Exit::Good } else { Exit::Lost })
}

/// The name of a step, beside its progress.
pub const fn step_name(step: Step) -> &'static str {
    match step {
        Step::Refine => "refine",
        Step::Write => "write",
    }
}

fn print(report: &PiecesReport) -> Result<()> {
    let found = match report.pieces_found {
        0 => String::new(),
        n => format!(", {n} there before"),
    };
    out::line(format_args!(
        "pieces    {}{found}, {} missing, {} skipped; {}, {}",
        report.pieces,
        report.pieces_missing,
        report.skipped.len(),
        out::count(report.sets, "set"),
        out::bytes(report.bytes)
    ))?;
    out::line(format_args!(
        "frames    {} in {:.1} s, {:.2} per second and core",
        report.frames, report.seconds, report.frames_per_core_second
    ))?;
    for s in &report.streams {
        let with = if s.model.is_empty() { String::new() } else { format!(" with {}", s.model) };
        out::line(format_args!(
            "  {}: {} by {}{with}, {:.1} % holes before, {:.1} % after",
            s.stream,
            out::count(s.frames, "frame"),
            s.engine,
            percent(s.holes_before, s),
            percent(s.holes, s)
        ))?;
        if let Some(note) = &s.note {
            out::line(format_args!("  note: {note}"))?;
        }
    }
    Ok(())
}

/// Share of the pixels of a stream, percent; 0 without any.
fn percent(pixels: u64, stream: &RelabelledStream) -> f64 {
    100.0 * pixels as f64 / stream.pixels.max(1) as f64
}
