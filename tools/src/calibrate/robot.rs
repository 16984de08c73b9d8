//! A robot from its URDF: kinematics, and the meshes of its links.

mod collada;

use crate::calibrate;
use crate::exit::UsageError;
use anyhow::{Context as _, Result, bail};
use depthrig_bus::files;
use depthrig_calibrate::Rigid;
use depthrig_calibrate::align::{Joint, JointKind, Kinematics, Limits, Mesh, Mimic};
use glam::{DQuat, DVec3, EulerRot};
use std::path::{Path, PathBuf};
use urdf_rs::{Geometry, JointType};

/// A URDF is no longer than this, bytes.
const URDF_MAX_BYTES: u64 = 16 << 20;
/// A mesh is no longer than this, bytes.
const MESH_MAX_BYTES: u64 = 512 << 20;
/// No arm has larger parts, metres.
const MAX_PART_M: f64 = 10.0;

/// A robot.
#[derive(Debug)]
pub struct Robot {
    /// How its links move.
    pub kinematics: Kinematics,
    /// The surface of each link, in the order of [`Kinematics::links`].
    pub meshes: Vec<Mesh>,
}

/// Where meshes are: `FOLDER`, or `PACKAGE=FOLDER`.
#[derive(Debug, Clone)]
pub struct MeshFolder {
    package: Option<String>,
    path: PathBuf,
}

/// Parses `FOLDER` or `PACKAGE=FOLDER`.
///
/// # Errors
/// When a part is empty.
pub fn mesh_folder(text: &str) -> Result<MeshFolder, String> {
    let (package, path) = match text.split_once('=') {
        Some((package, path)) => (Some(package.to_owned()), path),
        None => (None, text),
    };
    if path.is_empty() || package.as_deref() == Some("") {
        return Err("write FOLDER or PACKAGE=FOLDER".to_owned());
    }
    Ok(MeshFolder { package, path: path.into() })
}

/// Reads a URDF and the meshes of what is visible of it.
///
/// # Errors
/// When a file is missing or damaged, or the links do not form a tree; the message names file and link.
pub fn read(urdf: &Path, folders: &[MeshFolder]) -> Result<Robot> {
    let named = || format!("{}: invalid URDF", urdf.display());
    let text = calibrate::text(urdf, URDF_MAX_BYTES, "")?;
    if text.contains("<xacro:") {
        bail!("{}: is xacro; expand it first: xacro {0} > robot.urdf", urdf.display());
    }
    let robot = urdf_rs::read_from_string(&text).with_context(named)?;
    let links: Vec<String> = robot.links.iter().map(|l| l.name.clone()).collect();
    let joints = robot.joints.iter().map(|j| joint(j, &links)).collect::<Result<_>>().with_context(named)?;
    let kinematics = Kinematics::new(links, joints).with_context(named)?;
    let mut meshes = Vec::new();
    for link in &robot.links {
        let mut whole = Mesh::default();
        for visual in &link.visual {
            let body = body(&visual.geometry, urdf, folders)
                .with_context(|| format!("{}: link {}", urdf.display(), link.name))?;
            let pose = pose(&visual.origin);
            whole.add(&body.mapped(|v| pose.transform(v)));
        }
        if let Some(far) = whole.vertices().iter().find(|v| v.length() > MAX_PART_M) {
            bail!(
                "{}: link {} reaches {:.0} m away from its origin; its mesh is in other units than metres, give it scale=\"0.001 0.001 0.001\"",
                urdf.display(),
                link.name,
                far.length()
            );
        }
        meshes.push(whole.welded());
    }
    if meshes.iter().all(|m| m.triangles().is_empty()) {
        bail!("{}: no link has a <visual> with a surface; use the URDF with the meshes", urdf.display());
    }
    Ok(Robot { kinematics, meshes })
}

fn joint(joint: &urdf_rs::Joint, links: &[String]) -> Result<Joint> {
    let link = |name: &str| {
        links
            .iter()
            .position(|l| l == name)
            .with_context(|| format!("joint {} names the link {name}, which does not exist", joint.name))
    };
    let kind = match joint.joint_type {
        JointType::Fixed => JointKind::Fixed,
        JointType::Revolute | JointType::Continuous => JointKind::Revolute,
        JointType::Prismatic => JointKind::Prismatic,
        JointType::Floating | JointType::Planar | JointType::Spherical => bail!(
            "joint {} has several axes ({:?}); make it fixed, so that the link above it is the robot's base",
            joint.name,
            joint.joint_type
        ),
    };
    let axis = DVec3::from_array(*joint.axis.xyz);
    let axis = match axis.try_normalize() {
        Some(axis) => axis,
        None if kind == JointKind::Fixed => DVec3::X,
        None => bail!("joint {} has no axis", joint.name),
    };
    let limit = &joint.limit;
    let limited = joint.joint_type != JointType::Continuous && limit.lower < limit.upper;
    Ok(Joint {
        name: joint.name.clone(),
        parent: link(&joint.parent.link)?,
        child: link(&joint.child.link)?,
        origin: pose(&joint.origin),
        axis,
        kind,
        limits: limited.then_some(Limits { lower: limit.lower, upper: limit.upper }),
        mimic: joint.mimic.as_ref().map(|m| Mimic {
            joint: m.joint.clone(),
            multiplier: m.multiplier.unwrap_or(1.0),
            offset: m.offset.unwrap_or(0.0),
        }),
    })
}

fn pose(pose: &urdf_rs::Pose) -> Rigid {
    rigid(DVec3::from_array(*pose.xyz), DVec3::from_array(*pose.rpy))
}

/// A pose from a place and from roll, pitch and yaw about fixed axes, radians, as URDF has them.
pub fn rigid(translation: DVec3, rpy: DVec3) -> Rigid {
    Rigid { rotation: DQuat::from_euler(EulerRot::ZYX, rpy.z, rpy.y, rpy.x), translation }
}

fn body(geometry: &Geometry, urdf: &Path, folders: &[MeshFolder]) -> Result<Mesh> {
    match geometry {
        Geometry::Box { size } => Ok(Mesh::cuboid(DVec3::from_array(**size))),
        Geometry::Cylinder { radius, length } => Ok(Mesh::cylinder(*radius, *length)),
        Geometry::Capsule { radius, length } => Ok(Mesh::capsule(*radius, *length)),
        Geometry::Sphere { radius } => Ok(Mesh::sphere(*radius)),
        Geometry::Mesh { filename, scale } => {
            let path = mesh_path(filename, urdf, folders)?;
            let scale = scale.map_or(DVec3::ONE, |s| DVec3::from_array(*s));
            Ok(mesh(&path)?.mapped(|v| v * scale))
        }
    }
}

/// The file that a URDF calls `name`.
fn mesh_path(name: &str, urdf: &Path, folders: &[MeshFolder]) -> Result<PathBuf> {
    let home = files::folder_of(urdf);
    let mut places: Vec<PathBuf> = Vec::new();
    let uri = name.strip_prefix("package://").or_else(|| name.strip_prefix("model://"));
    if let Some(uri) = uri {
        let (package, rest) = uri.split_once('/').unwrap_or(("", uri));
        let of_package = folders.iter().filter(|f| f.package.as_deref() == Some(package));
        places.extend(of_package.map(|f| f.path.join(rest)));
        for folder in folders.iter().filter(|f| f.package.is_none()) {
            places.push(folder.path.join(uri));
            places.push(folder.path.join(rest));
        }
        // A package's own files lie around its URDF.
        let home = home.canonicalize().unwrap_or_else(|_| home.to_owned());
        for above in home.ancestors() {
            if above.file_name().is_some_and(|n| n == package) {
                places.push(above.join(rest));
            }
            places.push(above.join(uri));
        }
    } else {
        let path = Path::new(name.strip_prefix("file://").unwrap_or(name));
        places.push(home.join(path));
        places.extend(folders.iter().map(|f| f.path.join(path)));
    }
    if let Some(found) = places.iter().find(|p| p.is_file()) {
        return Ok(found.clone());
    }
    let cure = match uri.and_then(|u| u.split_once('/')) {
        Some((package, _)) => format!("name the folder of the package: --meshes {package}=FOLDER"),
        None => "name the folder that it is in: --meshes FOLDER".to_owned(),
    };
    Err(UsageError(format!("the mesh {name} was not found; {cure}")).into())
}

fn mesh(path: &Path) -> Result<Mesh> {
    let bytes =
        files::read(path, MESH_MAX_BYTES).with_context(|| format!("{}: cannot be read", path.display()))?;
    let unreadable = || format!("{}: cannot be read as a mesh; STL, DAE and OBJ can", path.display());
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("dae")) {
        let text = std::str::from_utf8(&bytes).with_context(unreadable)?;
        let whole = collada::read(text).with_context(unreadable)?;
        return with_triangles(whole, path);
    }
    let scene = mesh_loader::Loader::default().load_from_slice(&bytes, path).with_context(unreadable)?;
    let mut whole = Mesh::default();
    for part in scene.meshes {
        let vertices = part.vertices.iter().map(|v| DVec3::from_array(v.map(f64::from))).collect();
        whole.add(&Mesh::new(vertices, part.faces).with_context(unreadable)?);
    }
    with_triangles(whole, path)
}

fn with_triangles(mesh: Mesh, path: &Path) -> Result<Mesh> {
    if mesh.triangles().is_empty() {
        bail!("{}: has no triangles", path.display());
    }
    Ok(mesh)
}
