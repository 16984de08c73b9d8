//! Removes depth seen in a mirror or through glass: scattered depth in the middle of nearer surfaces.
//!
//! The image is looked at in blocks. Blocks that touch and have about the same depth are a patch. A patch that is full
//! of holes, smaller than a tenth of the image and surrounded by nearer surfaces is taken for a reflection or a view
//! through glass, and becomes a hole; it is then filled from its frame. A dark opening that a camera hardly sees into is
//! closed by the same rule.

/// Blocks per row of the image.
const BLOCKS: usize = 160;
/// Inverse depth of blocks of one patch differs less than this, relative to the nearer one.
const STEP: f32 = 0.12;
/// A block whose nearest pixel is nearer than its farthest by this factor lies on an edge and belongs to no patch.
const EDGE: f32 = 1.2;
/// A patch with more depth than this is trusted.
const DENSE: f64 = 0.85;
/// So much of a patch's border must be nearer.
const ENCLOSED: f64 = 0.8;
/// The largest patch that is taken out, a part of the image.
const LARGEST: f64 = 0.1;

/// Contents of a block.
#[derive(Debug, Clone, Copy, Default)]
struct Block {
    /// Pixels with depth.
    pixels: u32,
    area: u32,
    /// Inverse depth of the farthest and of the nearest of them.
    far: f32,
    near: f32,
    patch: Patch,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
enum Patch {
    /// Not looked at yet.
    #[default]
    Open,
    /// Empty, or on an edge.
    None,
    Number(u32),
}

/// Finds such patches; keeps its memory from image to image.
#[derive(Debug, Default)]
pub(super) struct Behind {
    blocks: Vec<Block>,
    to_visit: Vec<u32>,
    members: Vec<u32>,
}

impl Behind {
    /// Makes room for images of this size.
    pub(super) fn resize(&mut self, w: usize, h: usize) {
        let side = side(w);
        let n = w.div_ceil(side) * h.div_ceil(side);
        self.blocks.clear();
        self.blocks.resize(n, Block::default());
        self.to_visit.clear();
        self.to_visit.reserve(n);
        self.members.clear();
        self.members.reserve(n);
    }

    /// Makes holes of such patches of `q`.
    pub(super) fn remove(&mut self, q: &mut [f32], w: usize) {
        let side = side(w);
        let columns = w.div_ceil(side);
        self.measure(q, w, side);
        for start in 0..self.blocks.len() {
            if self.blocks[start].patch == Patch::Open {
                self.grow(start, columns);
                if self.is_behind(columns, q.len() as f64) {
                    for i in &self.members {
                        let bx = *i as usize % columns;
                        let by = *i as usize / columns;
                        for row in q[by * side * w..].chunks_mut(w).take(side) {
                            row[bx * side..((bx + 1) * side).min(w)].fill(0.0);
                        }
                    }
                }
            }
        }
    }

    fn measure(&mut self, q: &[f32], w: usize, side: usize) {
        let columns = w.div_ceil(side);
        for (blocks, rows) in self.blocks.chunks_mut(columns).zip(q.chunks(side * w)) {
            blocks.fill(Block { far: f32::MAX, ..Block::default() });
            for row in rows.chunks(w) {
                for (block, pixels) in blocks.iter_mut().zip(row.chunks(side)) {
                    block.area += pixels.len() as u32;
                    for q in pixels {
                        block.pixels += u32::from(*q > 0.0);
                        block.near = block.near.max(*q);
                        block.far = block.far.min(if *q > 0.0 { *q } else { f32::MAX });
                    }
                }
            }
            for block in blocks {
                let is_part = block.pixels > 0 && block.near < EDGE * block.far;
                block.patch = if is_part { Patch::Open } else { Patch::None };
            }
        }
    }

    /// Collects the blocks of the patch of `start` in `members`.
    fn grow(&mut self, start: usize, columns: usize) {
        let number = Patch::Number(start as u32);
        self.members.clear();
        self.to_visit.push(start as u32);
        self.blocks[start].patch = number;
        while let Some(i) = self.to_visit.pop() {
            self.members.push(i);
            let here = self.blocks[i as usize].near;
            for j in neighbours(i as usize, columns, self.blocks.len()).into_iter().flatten() {
                let there = &mut self.blocks[j];
                if there.patch == Patch::Open && (there.near - here).abs() < STEP * there.near.max(here) {
                    there.patch = number;
                    self.to_visit.push(j as u32);
                }
            }
        }
    }

    /// Whether the patch in `members` lies behind what surrounds it.
    fn is_behind(&self, columns: usize, whole: f64) -> bool {
        let number = self.members.first().map(|i| self.blocks[*i as usize].patch);
        let mut nearer = 0.0;
        let mut not = 0.0;
        let mut pixels = 0.0;
        let mut area = 0.0;
        for i in &self.members {
            let here = self.blocks[*i as usize];
            pixels += f64::from(here.pixels);
            area += f64::from(here.area);
            for j in neighbours(*i as usize, columns, self.blocks.len()) {
                match j.map(|j| self.blocks[j]) {
                    // An empty block says nothing but that there are holes.
                    Some(there) if there.pixels == 0 => area += 0.25 * f64::from(there.area),
                    Some(there) if Some(there.patch) == number => {}
                    Some(there) if there.near > here.near * (1.0 + STEP) => nearer += 1.0,
                    _ => not += 1.0,
                }
            }
        }
        area <= LARGEST * whole
            && pixels < DENSE * area
            && nearer > 0.0
            && nearer >= ENCLOSED * (nearer + not)
    }
}

/// Edge of a block, pixels.
const fn side(w: usize) -> usize {
    let side = w.div_ceil(BLOCKS);
    if side < 4 { 4 } else { side }
}

/// The blocks left, right, above and below, where there are.
fn neighbours(i: usize, columns: usize, n: usize) -> [Option<usize>; 4] {
    let x = i % columns;
    [
        (x > 0).then(|| i - 1),
        (x + 1 < columns).then(|| i + 1),
        i.checked_sub(columns),
        (i + columns < n).then(|| i + columns),
    ]
}
