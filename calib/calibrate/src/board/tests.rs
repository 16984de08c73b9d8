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
