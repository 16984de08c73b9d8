//! Triangle meshes, and coarser copies of them for small images.

use depthrig_calib::{Error, ErrorKind, Result};
use glam::{DVec3, IVec3};
use std::collections::HashMap;

/// A surface of triangles.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    pub(super) vertices: Vec<DVec3>,
    pub(super) triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// From vertices, metres in the frame of their link, and indices of three vertices a triangle, in any order.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for a vertex that is not finite and for a triangle of a vertex that does not exist.
    pub fn new(vertices: Vec<DVec3>, triangles: Vec<[u32; 3]>) -> Result<Self> {
        let bad = |what: String| Err(Error::new(ErrorKind::BadInput, what));
        if let Some(i) = vertices.iter().position(|v| !v.is_finite()) {
            return bad(format!("vertex {i} of a mesh is not finite"));
        }
        if let Some(t) = triangles.iter().find(|t| t.iter().any(|i| *i as usize >= vertices.len())) {
            return bad(format!("a triangle of a mesh has the vertices {t:?}, there are {}", vertices.len()));
        }
        Ok(Self { vertices, triangles })
    }

    /// The vertices, metres.
    pub fn vertices(&self) -> &[DVec3] {
        &self.vertices
    }

    /// The triangles, as indices of vertices.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// This mesh and another one's triangles.
    pub fn add(&mut self, other: &Self) {
        let from = self.vertices.len() as u32;
        self.vertices.extend_from_slice(&other.vertices);
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|i| i + from)));
    }

    /// The mesh with its vertices where `to` puts them.
    pub fn mapped(&self, to: impl Fn(DVec3) -> DVec3) -> Self {
        Self { vertices: self.vertices.iter().map(|v| to(*v)).collect(), triangles: self.triangles.clone() }
    }

    /// The mesh with one vertex where several have the same place, as files with three vertices a triangle have them.
    pub fn welded(&self) -> Self {
        let mut known: HashMap<[u64; 3], u32> = HashMap::with_capacity(self.vertices.len() / 4);
        let mut vertices = Vec::new();
        let mut moved_to: Vec<u32> = Vec::with_capacity(self.vertices.len());
        for vertex in &self.vertices {
            let index = *known.entry(vertex.to_array().map(f64::to_bits)).or_insert_with(|| {
                vertices.push(*vertex);
                vertices.len() as u32 - 1
            });
            moved_to.push(index);
        }
        let triangles = self.triangles.iter().map(|t| t.map(|i| moved_to[i as usize])).collect();
        Self { vertices, triangles }
    }

    /// A coarser mesh: the vertices in each cube of side `cell` (metres) become their mean, and triangles without area vanish
    /// (Rossignac and Borrel, Multi-resolution 3D approximations for rendering complex scenes, 1993).
    pub(super) fn coarser(&self, cell: f64) -> Self {
        let mut cells: HashMap<IVec3, u32> = HashMap::new();
        let mut sums: Vec<DVec3> = Vec::new();
        let mut counts: Vec<f64> = Vec::new();
        let mut moved_to: Vec<u32> = Vec::with_capacity(self.vertices.len());
        for vertex in &self.vertices {
            let at = (*vertex / cell).floor().as_ivec3();
            let index = *cells.entry(at).or_insert_with(|| {
                sums.push(DVec3::ZERO);
                counts.push(0.0);
                sums.len() as u32 - 1
            });
            sums[index as usize] += *vertex;
            counts[index as usize] += 1.0;
            moved_to.push(index);
        }
        let mut triangles: Vec<[u32; 3]> = Vec::new();
        for triangle in &self.triangles {
            let mut t = triangle.map(|i| moved_to[i as usize]);
            if t[0] != t[1] && t[1] != t[2] && t[2] != t[0] {
                t.sort_unstable();
                triangles.push(t);
            }
        }
        triangles.sort_unstable();
        triangles.dedup();
        let vertices = sums.iter().zip(&counts).map(|(sum, count)| *sum / *count).collect();
        Self { vertices, triangles }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn welded_meshes_have_each_vertex_once_and_the_same_surface() {
        let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let apart = vec![
            corner(0.0, 0.0),
            corner(1.0, 0.0),
            corner(0.0, 1.0),
            corner(1.0, 0.0),
            corner(1.0, 1.0),
            corner(0.0, 1.0),
        ];
        let mesh = Mesh::new(apart, vec![[0, 1, 2], [3, 4, 5]]).unwrap();
        let welded = mesh.welded();
        assert_eq!(welded.vertices().len(), 4);
        let places = |m: &Mesh| -> Vec<DVec3> {
            m.triangles().iter().flatten().map(|i| m.vertices()[*i as usize]).collect()
        };
        assert_eq!(places(&welded), places(&mesh));
        assert!(mesh.coarser(10.0).triangles().is_empty());
        assert!(Mesh::new(Vec::new(), vec![[0, 0, 0]]).is_err());
    }
}
