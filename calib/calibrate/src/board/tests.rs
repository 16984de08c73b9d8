use super::*;

#[test]
fn a_board_survives_its_file() {
    for pattern in [Pattern::Charuco, Pattern::Aprilgrid, Pattern::Chessboard] {
        let board = Board::for_paper(pattern, 10, 7, None, Paper::parse("a4").unwrap()).unwrap();
        let again = Board::from_toml(&toml::to_string(&board).unwrap()).unwrap();
        assert_eq!(board, again);
    }
}

#[test]
fn bad_boards_are_refused_with_the_cure() {
    let of = |text: &str| Board::from_toml(text).unwrap_err().to_string();
    let charuco = "pattern = \"charuco\"\ncolumns = 10\nrows = 7\nsquare_mm = 25.0\n";
    assert!(of(charuco).contains("marker_mm is missing"));
    assert!(
        of(&format!("{charuco}marker_mm = 30.0\ndictionary = \"DICT_4X4_50\"\n"))
            .contains("between 0 and square_mm")
    );
    assert!(
        of(&format!("{charuco}marker_mm = 20.0\ndictionary = \"DICT_9X9\"\n")).contains("unknown dictionary")
    );
    let ruler =
        format!("{charuco}marker_mm = 20.0\ndictionary = \"DICT_4X4_50\"\nmeasured_ruler_mm = 25.0\n");
    assert!(of(&ruler).contains("measure the line again"));
    assert!(
        of("pattern = \"chessboard\"\ncolumns = 8\nrows = 8\nsquare_mm = 25.0\n").contains("upside down")
    );
    assert!(of("pattern = \"charuco\"\ncolums = 8\n").contains("colums"));
}

#[test]
fn a_printer_that_scales_moves_every_corner() {
    let mut board =
        Board::for_paper(Pattern::Charuco, 10, 7, Some(25.0), Paper::parse("a4").unwrap()).unwrap();
    let drawn = board.corner(13);
    board.measured_ruler_mm = Some(97.0);
    assert!((board.corner(13) - drawn * 0.97).length() < 1e-12);
}

/// The first code of tag36h11 as its makers publish it (`0xd5d628584`, Olson 2011): the highest bit is at the top left, 1 is white. Kalibr's
/// boards have the tags this way up.
#[test]
fn an_aprilgrid_has_the_first_tag_at_the_bottom_left_the_right_way_up() {
    let board = Board::for_paper(Pattern::Aprilgrid, 6, 6, Some(20.0), Paper::parse("a4").unwrap()).unwrap();
    let drawing = Drawing::new(&board, Paper::parse("a4").unwrap()).unwrap();
    // The grid with the small squares in its gaps, in the middle of the sheet above the footer of 12 mm.
    let extent = 6.0 * 26.0 + 6.0;
    let left = (297.0 - extent) / 2.0 + 6.0;
    let top = 10.0 + (210.0 - 32.0 - extent) / 2.0 + 6.0 + 5.0 * 26.0;
    let is_black = |x: f64, y: f64| {
        drawing.black.iter().any(|r| (r.x..r.x + r.width).contains(&x) && (r.y..r.y + r.height).contains(&y))
    };
    for bit in 0..36 {
        let cell = |i: usize| (2.5 + i as f64) * 2.0;
        let white = 0xd_5d62_8584_u64 >> (35 - bit) & 1 == 1;
        assert_eq!(is_black(left + cell(bit % 6), top + cell(bit / 6)), !white, "bit {bit}");
    }
}
