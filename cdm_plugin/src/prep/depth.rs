//! Raw depth to inverse depth: a table of all 65536 readings, and the pixels that the network sees.

/// 1/m of every reading in one unit.
#[derive(Debug)]
pub(super) struct DepthTable {
    max_depth_m: f64,
    unit_m: f64,
    inverse: Vec<f32>,
}

/// Units per metre: the whole number that `unit_m` is the inverse of, if it is one. The official script divides readings by
/// such a number; and units come from devices as `f32`, where 0.001 is off by 5e-8 of itself.
pub(super) fn units_per_metre(unit_m: f64) -> f64 {
    let exact = 1.0 / unit_m;
    let whole = exact.round();
    if (exact - whole).abs() <= 1e-7 * exact { whole } else { exact }
}

impl DepthTable {
    pub(super) fn new(max_depth_m: f64) -> Self {
        Self { max_depth_m, unit_m: 0.0, inverse: vec![0.0; 1 << 16] }
    }

    /// Makes the table one for readings in units of `unit_m` metres.
    pub(super) fn use_unit(&mut self, unit_m: f64) {
        if self.unit_m == unit_m {
            return;
        }
        self.unit_m = unit_m;
        let per_metre = units_per_metre(unit_m);
        for (raw, inverse) in self.inverse.iter_mut().enumerate() {
            let metres = raw as f64 / per_metre;
            let hole = raw == 0 || raw == usize::from(u16::MAX) || metres > self.max_depth_m;
            // A unit can be so small that the inverse of a reading exceeds `f32`.
            *inverse = if hole { 0.0 } else { (1.0 / metres).min(f64::from(f32::MAX)) as f32 };
        }
    }

    /// Inverse depth at the given rows and columns of `raw`; whether any of it is above 0.
    #[inline(always)]
    pub(super) fn sample(
        &self,
        raw: &[u16],
        width: usize,
        rows: &[u32],
        columns: &[u32],
        out: &mut [f32],
    ) -> bool {
        let Some(table) = self.inverse.first_chunk::<{ 1 << 16 }>() else { return false };
        let mut most = 0.0f32;
        for (row, out) in rows.iter().zip(out.chunks_exact_mut(columns.len())) {
            let raw = &raw[*row as usize * width..][..width];
            for (column, out) in columns.iter().zip(out) {
                *out = table[usize::from(raw[*column as usize])];
                most = most.max(*out);
            }
        }
        most > 0.0
    }
}
