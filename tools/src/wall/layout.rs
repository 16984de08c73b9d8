//! Where tiles lie on the screen, in rows and columns of characters.

/// Smallest tile: narrower or lower ones show nothing.
const MIN_COLUMNS: usize = 12;
const MIN_ROWS: usize = 4;
/// Between two tiles.
const GAP: usize = 1;
/// Sides of a usual image.
const ASPECT: f64 = 16.0 / 9.0;

/// Size of a character in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cell {
    /// Width.
    pub width: usize,
    /// Height.
    pub height: usize,
}

/// A part of the screen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Area {
    /// First row, from 1.
    pub row: usize,
    /// Number of rows.
    pub rows: usize,
    /// Number of columns.
    pub columns: usize,
}

/// Where something is drawn, from row 1 and column 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    /// Row.
    pub row: usize,
    /// Column.
    pub column: usize,
}

impl Place {
    /// The place one row below.
    pub const fn below(self) -> Self {
        Self { row: self.row + 1, column: self.column }
    }
}

/// Tiles of one size, side by side and in rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    /// Number of tiles that have room.
    pub shown: usize,
    /// Columns of a tile.
    pub columns: usize,
    /// Rows of a tile's image; its label is one more.
    pub rows: usize,
    row: usize,
    per_row: usize,
}

impl Grid {
    /// The largest tiles that show `count` streams; fewer streams where not all have room.
    pub fn new(count: usize, area: Area, cell: Cell) -> Self {
        for shown in (1..=count).rev() {
            let fitting = (1..=shown).filter_map(|per_row| Self::with(shown, per_row, area));
            if let Some(grid) = fitting.max_by_key(|grid| grid.image_columns(cell)) {
                return grid;
            }
        }
        Self { shown: 0, columns: 0, rows: 0, row: area.row, per_row: 1 }
    }

    fn with(shown: usize, per_row: usize, area: Area) -> Option<Self> {
        let columns = ((area.columns + GAP) / per_row).checked_sub(GAP)?;
        let rows = (area.rows / shown.div_ceil(per_row)).checked_sub(1)?;
        let fits = columns >= MIN_COLUMNS && rows + 1 >= MIN_ROWS;
        fits.then_some(Self { shown, columns, rows, row: area.row, per_row })
    }

    /// Columns of a usual image in a tile.
    fn image_columns(self, cell: Cell) -> usize {
        let by_height = (self.rows * cell.height) as f64 * ASPECT / cell.width as f64;
        self.columns.min(by_height as usize)
    }

    /// Where the tile of a number is.
    pub const fn place(self, index: usize) -> Place {
        Place {
            row: self.row + index / self.per_row * (self.rows + 1),
            column: 1 + index % self.per_row * (self.columns + GAP),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CELL: Cell = Cell { width: 10, height: 20 };

    #[test]
    fn tiles_never_overlap_or_leave_their_area() {
        for count in 1..20 {
            for rows in 1..60 {
                for columns in [1, 11, 12, 40, 80, 200] {
                    let area = Area { row: 7, rows, columns };
                    let grid = Grid::new(count, area, CELL);
                    assert!(grid.shown <= count);
                    let mut taken = std::collections::HashSet::new();
                    for i in 0..grid.shown {
                        let place = grid.place(i);
                        for row in place.row..=place.row + grid.rows {
                            for column in place.column..place.column + grid.columns {
                                assert!(row >= 7 && row < 7 + rows && column >= 1 && column <= columns);
                                assert!(taken.insert((row, column)), "{count} {area:?}");
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn all_tiles_are_shown_where_there_is_room_and_some_where_there_is_not() {
        let grid = |rows, columns| Grid::new(14, Area { row: 1, rows, columns }, CELL);
        assert_eq!(grid(30, 160).shown, 14);
        assert!((1..14).contains(&grid(10, 60).shown));
        assert_eq!(grid(3, 60).shown, 0);
        // One tile takes all of it.
        let one = Grid::new(1, Area { row: 1, rows: 20, columns: 60 }, CELL);
        assert_eq!((one.columns, one.rows), (60, 19));
    }
}
