//! `depthrig calibrate board`: a board to print.

use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use anyhow::{Context as _, Result};
use depthrig_calibrate::board::{Board, Drawing, Paper, Pattern};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Writes NAME.toml, NAME.pdf and NAME.svg. Print the PDF at 100 %, measure the ruler line from tick to tick, and write its length
into NAME.toml (measured_ruler_mm). Glue the sheet onto something flat and stiff.

Exit codes: 0 written, 1 failure, 2 wrong usage, or a board that does not fit the paper.

Examples:
  depthrig calibrate board
  depthrig calibrate board --paper a3 --columns 14 --rows 9 --name large
  depthrig calibrate board --pattern aprilgrid --columns 6 --rows 6 --square-mm 20";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct BoardArgs {
    /// Pattern: charuco, chessboard or aprilgrid
    #[arg(long, value_name = "PATTERN", default_value = "charuco", value_parser = pattern)]
    pattern: Pattern,
    /// Squares across, or tags of an aprilgrid
    #[arg(long, value_name = "N", default_value_t = 11, value_parser = clap::value_parser!(u32).range(1..=100))]
    columns: u32,
    /// Squares down, or tags of an aprilgrid
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=100))]
    rows: u32,
    /// Side of a square or tag, millimetres [default: the largest that fits]
    #[arg(long, value_name = "MM", value_parser = crate::args::length_mm)]
    square_mm: Option<f64>,
    /// Paper: a4, a3, a2, a1, a0, letter, tabloid or WIDTHxHEIGHT in millimetres
    #[arg(long, value_name = "SIZE", default_value = "a4", value_parser = paper)]
    paper: Paper,
    /// Name of the files to write, without extension
    #[arg(long, value_name = "NAME", default_value = "board")]
    name: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
}

fn pattern(text: &str) -> Result<Pattern, String> {
    match text {
        "charuco" => Ok(Pattern::Charuco),
        "chessboard" => Ok(Pattern::Chessboard),
        "aprilgrid" => Ok(Pattern::Aprilgrid),
        _ => Err("use charuco, chessboard or aprilgrid".to_owned()),
    }
}

fn paper(text: &str) -> Result<Paper, String> {
    Paper::parse(text).map_err(|e| e.to_string())
}

/// Draws and writes.
pub fn run(args: &BoardArgs) -> Result<Exit> {
    let usage = |e: depthrig_calib::Error| UsageError(e.to_string());
    let board =
        Board::for_paper(args.pattern, args.columns, args.rows, args.square_mm, args.paper).map_err(usage)?;
    let drawing = Drawing::new(&board, args.paper).map_err(usage)?;
    let file = |extension: &str| {
        let mut path = args.name.clone().into_os_string();
        path.push(extension);
        OutFile::new(&PathBuf::from(path), args.overwrite, &[])
    };
    // All are checked before one is written.
    let description = file(".toml")?;
    let pdf = file(".pdf")?;
    let svg = file(".svg")?;
    let text = board.to_toml().context("the board's description")?;
    pdf.write(&drawing.to_pdf())?;
    svg.write(drawing.to_svg().as_bytes())?;
    description.write(text.as_bytes())?;
    out::line(format_args!(
        "board     {} (print at 100 %), {}\nmeasure   the ruler line, {} mm from tick to tick, and write its length into {} (measured_ruler_mm)",
        pdf.path().display(),
        svg.path().display(),
        board.ruler_mm,
        description.path().display()
    ))?;
    Ok(Exit::Good)
}
