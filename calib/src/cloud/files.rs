//! Files of points: PLY (binary, little-endian) and PCD (binary, version 0.7).

use super::PointCloud;
use crate::{Error, ErrorKind, Result};
use std::io::Write;

/// Writes a cloud as PLY: `float x y z`, and `uchar red green blue` when it has colour. MeshLab, CloudCompare, Open3D
/// and Blender read it.
///
/// # Errors
/// [`ErrorKind::Io`] as `out` reports; [`ErrorKind::BadInput`] when the cloud has another number of colours than
/// points.
pub fn write_ply(cloud: &PointCloud, out: &mut impl Write) -> Result<()> {
    let has_color = has_color(cloud)?;
    let colors =
        if has_color { "property uchar red\nproperty uchar green\nproperty uchar blue\n" } else { "" };
    let head = format!(
        "ply\nformat binary_little_endian 1.0\ncomment metres; x right, y down, z forward\nelement vertex {}\n\
         property float x\nproperty float y\nproperty float z\n{colors}end_header\n",
        cloud.points.len()
    );
    put(out, head.as_bytes())?;
    for (i, p) in cloud.points.iter().enumerate() {
        let mut row = [0; 15];
        point(p, &mut row);
        let len = if has_color {
            row[12..].copy_from_slice(&cloud.colors[i]);
            15
        } else {
            12
        };
        put(out, &row[..len])?;
    }
    flush(out)
}

/// Writes a cloud as PCD: `x y z`, and `rgb` packed as the Point Cloud Library does (0x00RRGGBB) when it has colour.
///
/// # Errors
/// As [`write_ply`].
pub fn write_pcd(cloud: &PointCloud, out: &mut impl Write) -> Result<()> {
    let has_color = has_color(cloud)?;
    let n = cloud.points.len();
    let (fields, size, kind, count) = if has_color {
        ("x y z rgb", "4 4 4 4", "F F F U", "1 1 1 1")
    } else {
        ("x y z", "4 4 4", "F F F", "1 1 1")
    };
    let head = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\n\
         WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    );
    put(out, head.as_bytes())?;
    for (i, p) in cloud.points.iter().enumerate() {
        let mut row = [0; 16];
        point(p, &mut row);
        let len = if has_color {
            let [r, g, b] = cloud.colors[i];
            row[12..].copy_from_slice(&[b, g, r, 0]);
            16
        } else {
            12
        };
        put(out, &row[..len])?;
    }
    flush(out)
}

fn has_color(cloud: &PointCloud) -> Result<bool> {
    let points = cloud.points.len();
    let colors = cloud.colors.len();
    if colors != 0 && colors != points {
        return Err(Error::new(
            ErrorKind::BadInput,
            format!("a cloud of {points} points has {colors} colours; give each point one, or none"),
        ));
    }
    Ok(colors != 0)
}

fn point(p: &[f32; 3], row: &mut [u8]) {
    for (bytes, v) in row.chunks_exact_mut(4).zip(p) {
        bytes.copy_from_slice(&v.to_le_bytes());
    }
}

fn put(out: &mut impl Write, bytes: &[u8]) -> Result<()> {
    out.write_all(bytes).map_err(failed)
}

fn flush(out: &mut impl Write) -> Result<()> {
    out.flush().map_err(failed)
}

fn failed(e: std::io::Error) -> Error {
    Error::new(ErrorKind::Io, format!("the point cloud cannot be written: {e}")).with_source(e)
}
