use super::*;
use crate::board::{Drawing, Paper};

/// Draws a board at so many pixels a millimetre: exact, with grey where a pixel is partly black.
fn drawn(board: &Board, pixels_per_mm: f64) -> (usize, usize, Vec<u8>) {
    let paper = Paper { width_mm: 330.0, height_mm: 280.0 };
    let drawing = Drawing::new(board, paper).unwrap();
    let width = (paper.width_mm * pixels_per_mm) as usize;
    let height = (paper.height_mm * pixels_per_mm) as usize;
    let mut black = vec![0.0; width * height];
    for r in &drawing.black {
        let share = |from: f64, size: f64, i: usize| {
            let low = (from * pixels_per_mm).max(i as f64);
            let high = ((from + size) * pixels_per_mm).min(i as f64 + 1.0);
            (high - low).max(0.0)
        };
        let first = |from: f64| (from * pixels_per_mm).floor() as usize;
        for y in first(r.y)..=first(r.y + r.height).min(height - 1) {
            for x in first(r.x)..=first(r.x + r.width).min(width - 1) {
                black[y * width + x] += share(r.x, r.width, x) * share(r.y, r.height, y);
            }
        }
    }
    (width, height, black.iter().map(|b| (230.0 - 200.0 * b.min(1.0)) as u8).collect())
}

#[test]
fn a_drawn_board_is_found_whole_and_its_corners_are_where_they_were_drawn() {
    let paper = Paper { width_mm: 330.0, height_mm: 280.0 };
    for (pattern, columns, rows, square) in [
        (Pattern::Charuco, 10, 7, 30.0),
        (Pattern::Chessboard, 10, 7, 30.0),
        (Pattern::Aprilgrid, 6, 5, 36.0),
    ] {
        let board = Board::for_paper(pattern, columns, rows, Some(square), paper).unwrap();
        let scale = 3.0;
        let (width, height, pixels) = drawn(&board, scale);
        let found = detector(&board).unwrap().detect(&GrayImage::new(width, height, &pixels).unwrap());
        assert_eq!(found.refused, None, "{pattern:?}");
        assert_eq!(found.corners.len(), board.corner_count(), "{pattern:?}");
        // The drawing is in the middle of the sheet, so the first corner's place is that of all.
        let at = |c: &FoundCorner| {
            let mm = board.corner(c.id).truncate() * 1e3;
            let up = if pattern == Pattern::Aprilgrid { DVec2::new(1.0, -1.0) } else { DVec2::ONE };
            c.pixel - mm * up * scale
        };
        let origin = found.corners.iter().map(at).sum::<DVec2>() / found.corners.len() as f64;
        for corner in &found.corners {
            assert!((at(corner) - origin).length() < 0.05, "{pattern:?} {corner:?}: {}", at(corner) - origin);
        }
    }
}

#[test]
fn a_white_image_has_no_board() {
    let board = Board::for_paper(Pattern::Charuco, 10, 7, None, Paper::parse("a4").unwrap()).unwrap();
    let pixels = vec![200; 640 * 480];
    let found = detector(&board).unwrap().detect(&GrayImage::new(640, 480, &pixels).unwrap());
    assert_eq!(found, Detection::default());
}
