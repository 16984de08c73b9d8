//! Meshes of triangles in a tree of boxes.

use glam::Vec3;

/// Triangles that a leaf of the tree holds at most.
const LEAF: usize = 4;

/// A mesh around the origin of its own frame.
#[derive(Debug, PartialEq)]
pub(crate) struct Mesh {
    /// Corners of each triangle, in the order of the leaves.
    triangles: Vec<[Vec3; 3]>,
    /// Normals at the corners.
    normals: Vec<[Vec3; 3]>,
    nodes: Vec<Node>,
    bound: f32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    low: Vec3,
    high: Vec3,
    /// First triangle of a leaf, or the second child; the first child follows its parent.
    at: u32,
    /// Triangles of a leaf; 0 for a node with children.
    count: u32,
}

/// A crossing of a ray and a triangle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    pub(crate) t: f32,
    pub(crate) triangle: u32,
    /// Weights of the second and the third corner.
    u: f32,
    v: f32,
}

impl Mesh {
    /// A mesh of corners and triangles, whose numbers must exist; edges that bend by less than 40° look smooth.
    pub(crate) fn new(corners: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let flat = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| corners[i as usize]);
            (b - a).cross(c - a)
        };
        let mut around: Vec<Vec<u32>> = vec![Vec::new(); corners.len()];
        for (i, t) in triangles.iter().enumerate() {
            for corner in t {
                around[*corner as usize].push(i as u32);
            }
        }
        let smooth = |t: &[u32; 3]| {
            let own = flat(t).normalize_or(Vec3::Z);
            t.map(|corner| {
                let others = around[corner as usize].iter().map(|i| flat(&triangles[*i as usize]));
                let near = others.filter(|n| n.normalize_or(Vec3::Z).dot(own) > 0.766);
                near.sum::<Vec3>().normalize_or(own)
            })
        };
        let mut parts: Vec<([Vec3; 3], [Vec3; 3])> =
            triangles.iter().map(|t| (t.map(|i| corners[i as usize]), smooth(t))).collect();
        let mut nodes = Vec::new();
        split(&mut parts, 0, &mut nodes);
        Self {
            triangles: parts.iter().map(|p| p.0).collect(),
            normals: parts.iter().map(|p| p.1).collect(),
            nodes,
            bound: corners.iter().map(|p| p.length()).fold(0.0, f32::max),
        }
    }

    /// The same mesh, `factor` times as large.
    pub(crate) fn scaled(&self, factor: f32) -> Self {
        Self {
            triangles: self.triangles.iter().map(|t| t.map(|p| p * factor)).collect(),
            normals: self.normals.clone(),
            nodes: self
                .nodes
                .iter()
                .map(|n| Node { low: n.low * factor, high: n.high * factor, ..*n })
                .collect(),
            bound: self.bound * factor,
        }
    }

    /// The lowest corner's height.
    pub(crate) fn low(&self) -> f32 {
        self.nodes.first().map_or(0.0, |n| n.low.z)
    }

    /// Radius of a sphere around the origin that holds it.
    pub(crate) const fn bound(&self) -> f32 {
        self.bound
    }

    /// The first triangle that a ray crosses within `near..far`, from either side.
    pub(crate) fn meet(&self, o: Vec3, d: Vec3, near: f32, far: f32) -> Option<Hit> {
        let inverse = d.recip();
        let mut best: Option<Hit> = None;
        let mut far = far;
        let mut open = [0u32; 64];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let at = open[depth];
            let Some(node) = self.nodes.get(at as usize) else { continue };
            let a = (node.low - o) * inverse;
            let b = (node.high - o) * inverse;
            let enter = a.min(b).max_element();
            let leave = a.max(b).min_element();
            // A NaN, of a ray within a box's side, counts as inside; rounding gets a margin.
            if enter > leave.abs().mul_add(1e-6, leave) || enter > far || leave < near {
                continue;
            }
            if node.count == 0 {
                if depth + 2 <= open.len() {
                    open[depth] = node.at;
                    open[depth + 1] = at + 1;
                    depth += 2;
                }
                continue;
            }
            for i in node.at..node.at + node.count {
                if let Some(hit) = cross(&self.triangles[i as usize], o, d, i)
                    && hit.t > near
                    && hit.t < far
                {
                    far = hit.t;
                    best = Some(hit);
                }
            }
        }
        best
    }

    /// The smoothed normal at a crossing, on the side that the ray came from.
    pub(crate) fn normal(&self, hit: Hit, d: Vec3) -> Vec3 {
        let [a, b, c] = self.triangles[hit.triangle as usize];
        let flat = (b - a).cross(c - a).normalize_or(Vec3::Z);
        let [p, q, r] = self.normals[hit.triangle as usize];
        let smooth = (p * (1.0 - hit.u - hit.v) + q * hit.u + r * hit.v).normalize_or(flat);
        let facing = if flat.dot(d) > 0.0 { -1.0 } else { 1.0 };
        if smooth.dot(d) * facing < -1e-3 { smooth * facing } else { flat * facing }
    }

    /// Every triangle.
    pub(crate) fn triangles(&self) -> &[[Vec3; 3]] {
        &self.triangles
    }
}

/// Adds the node of `parts`, whose first is triangle `first`, and its children.
fn split(parts: &mut [([Vec3; 3], [Vec3; 3])], first: u32, nodes: &mut Vec<Node>) {
    let corners = || parts.iter().flat_map(|p| p.0);
    let low = corners().fold(Vec3::INFINITY, Vec3::min);
    let high = corners().fold(Vec3::NEG_INFINITY, Vec3::max);
    let at = nodes.len();
    nodes.push(Node { low, high, at: first, count: parts.len() as u32 });
    if parts.len() <= LEAF {
        return;
    }
    let size = high - low;
    let axis = (0..3).fold(0, |best, i| if size[i] > size[best] { i } else { best });
    let middle = |p: &([Vec3; 3], [Vec3; 3])| p.0[0][axis] + p.0[1][axis] + p.0[2][axis];
    let half = parts.len() / 2;
    parts.select_nth_unstable_by(half, |a, b| middle(a).total_cmp(&middle(b)));
    let (left, right) = parts.split_at_mut(half);
    split(left, first, nodes);
    let second = nodes.len() as u32;
    split(right, first + half as u32, nodes);
    nodes[at] = Node { low, high, at: second, count: 0 };
}

/// Edges belong to both triangles, with a margin for rounding: no ray passes between two of them.
const MARGIN: f32 = -1e-5;

/// Möller and Trumbore 1997.
fn cross(triangle: &[Vec3; 3], o: Vec3, d: Vec3, number: u32) -> Option<Hit> {
    let [a, b, c] = *triangle;
    let (ab, ac) = (b - a, c - a);
    let p = d.cross(ac);
    let det = ab.dot(p);
    if det.abs() < 1e-20 {
        return None;
    }
    let s = (o - a) / det;
    let u = s.dot(p);
    let q = s.cross(ab);
    let v = d.dot(q);
    (u >= MARGIN && v >= MARGIN && u + v <= 1.0 - MARGIN).then(|| Hit {
        t: ac.dot(q),
        triangle: number,
        u,
        v,
    })
}
