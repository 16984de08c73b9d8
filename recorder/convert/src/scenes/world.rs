//! The world of a sample as a folder of meshes, for renderers that are not ours.

use super::sample::{Lens, png};
use depthrig_recorder::{Error, ErrorKind, Result};
use depthrig_sim::synthetic::scenes::{Settings, TRUTH_UNIT_M, WorldModel, WorldPart};
use image::ExtendedColorType;
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};

#[derive(Serialize)]
struct Record {
    format: u32,
    seed: u64,
    number: u64,
    width: u32,
    height: u32,
    intrinsics: Lens,
    /// Columns of the colour camera's rotation in the world, and its place, metres.
    camera: [[f64; 3]; 4],
    truth_unit_m: f64,
    exposure: f32,
    white: [f32; 3],
    around: [[f32; 3]; 2],
    lamps: Vec<Lamp>,
    parts: Vec<Part>,
}

#[derive(Serialize)]
struct Lamp {
    center: [f32; 3],
    radius: f32,
    power: f32,
    color: [f32; 3],
}

#[derive(Serialize)]
struct Part {
    file: String,
    surface: &'static str,
    material: u8,
    infrared: f32,
}

/// Writes the world into `folder/NUMBER`, ten digits: `world.json`, a PLY file of each part with normals and linear
/// colours at its corners, and the images `color.png` (without the faults of a camera), `truth.png`, `material.png` and
/// `part.png` (16 bits, the part that a pixel shows). `world.json` comes last. Returns the folder.
///
/// # Errors
/// [`ErrorKind::BadInput`] when the folder is there already, and those of the file system.
pub fn write_world(world: &WorldModel, settings: &Settings, folder: &Path) -> Result<PathBuf> {
    let folder = folder.join(format!("{:010}", world.number));
    if folder.exists() {
        return Err(Error::new(
            ErrorKind::BadInput,
            format!("{} exists; name another folder or remove it", folder.display()),
        ));
    }
    depthrig_bus::umask::create_dir_all(&folder).map_err(|e| Error::io("create the folder", &folder, e))?;
    let write = |name: &str, bytes: &[u8]| {
        let path = folder.join(name);
        depthrig_bus::files::replace(&path, bytes).map_err(|e| Error::io("write", &path, e))
    };
    let size = (settings.width, settings.height);
    let gray16 = |v: &[u16]| png(bytemuck::cast_slice(v), size, ExtendedColorType::L16);
    write("color.png", &png(&world.color, size, ExtendedColorType::Rgb8)?)?;
    write("truth.png", &gray16(&world.truth)?)?;
    write("material.png", &png(&world.material, size, ExtendedColorType::L8)?)?;
    write("part.png", &gray16(&world.part)?)?;
    let name = |i: usize| format!("part-{i:04}.ply");
    for (i, part) in world.parts.iter().enumerate() {
        write(&name(i), &ply(part))?;
    }
    let record = Record {
        format: 1,
        seed: settings.seed,
        number: world.number,
        width: size.0,
        height: size.1,
        intrinsics: Lens::of(&world.intrinsics),
        camera: world.camera,
        truth_unit_m: TRUTH_UNIT_M,
        exposure: world.exposure,
        white: world.white,
        around: world.around,
        lamps: world
            .lamps
            .iter()
            .map(|l| Lamp { center: l.center, radius: l.radius, power: l.power, color: l.color })
            .collect(),
        parts: world
            .parts
            .iter()
            .enumerate()
            .map(|(i, p)| Part {
                file: name(i),
                surface: p.surface,
                material: p.material,
                infrared: p.infrared,
            })
            .collect(),
    };
    let json = serde_json::to_vec_pretty(&record)
        .map_err(|e| Error::new(ErrorKind::Codec, format!("{}: {e}", folder.display())))?;
    write("world.json", &json)?;
    Ok(folder)
}

/// A binary PLY file.
fn ply(part: &WorldPart) -> Vec<u8> {
    let mut head = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", part.corners.len());
    for name in ["x", "y", "z", "nx", "ny", "nz", "r", "g", "b"] {
        let _ = writeln!(head, "property float {name}");
    }
    let _ = write!(
        head,
        "element face {}\nproperty list uchar uint vertex_indices\nend_header\n",
        part.triangles.len()
    );
    let mut out = head.into_bytes();
    for ((p, n), c) in part.corners.iter().zip(&part.normals).zip(&part.colors) {
        for v in p.iter().chain(n).chain(c) {
            out.extend(v.to_le_bytes());
        }
    }
    for triangle in &part.triangles {
        out.push(3);
        for i in triangle {
            out.extend(i.to_le_bytes());
        }
    }
    out
}
