//! Triangles of COLLADA files (.dae), placed as their scene places them.
//!
//! Read here because `mesh-loader` 0.1 takes a node's translation of less than 10 mm for none, multiplies nested transforms in the wrong order
//! and keeps one of two instances: a Panda's fourth link would be 3 mm beside its place. Of a document only the geometry of its scene
//! is read (COLLADA 1.4.1, chapters 5 and 6). `<up_axis>` is ignored, as in RViz and MoveIt: meshes of URDFs are in the frame of
//! their link as they stand.

use anyhow::{Context as _, Result, bail};
use depthrig_calibrate::align::Mesh;
use glam::{DMat4, DVec3};
use roxmltree::{Document, Node};
use std::collections::HashMap;

/// Nodes inside nodes, and nodes that stand for others; more is a loop.
const MAX_DEPTH: usize = 64;
/// Nodes that stand for others may repeat a small file's geometry without end; this is more than any robot's link has.
const MAX_TRIANGLES: usize = 20_000_000;

/// The surface that the file's scene shows, metres.
///
/// # Errors
/// When the text is not COLLADA, refers to what it does not have, or shows geometry in a way that is not supported; the message
/// names the element.
pub fn read(text: &str) -> Result<Mesh> {
    let document = Document::parse(text).context("invalid XML")?;
    let root = document.root_element();
    if root.tag_name().name() != "COLLADA" {
        bail!("the document's element is <{}>, not <COLLADA>", root.tag_name().name());
    }
    let unit: f64 =
        match child(root, "asset").and_then(|a| child(a, "unit")).and_then(|u| u.attribute("meter")) {
            Some(meter) => meter.trim().parse().with_context(|| format!("unit meter=\"{meter}\""))?,
            None => 1.0,
        };
    if !(unit > 0.0 && unit.is_finite()) {
        bail!("unit meter=\"{unit}\" is not positive");
    }
    let mut reader = Reader { by_id: HashMap::new(), mesh: Mesh::default() };
    for node in root.descendants() {
        if let Some(id) = node.attribute("id") {
            reader.by_id.entry(id).or_insert(node);
        }
    }
    let metres = DMat4::from_scale(DVec3::splat(unit));
    let scene = child(root, "scene").and_then(|s| child(s, "instance_visual_scene"));
    let scene = match scene {
        Some(instance) => Some(reader.target(instance, "url")?),
        None => root
            .descendants()
            .find(|n| n.has_tag_name((n.tag_name().namespace().unwrap_or(""), "visual_scene"))),
    };
    match scene {
        Some(scene) => reader.nodes(scene, metres, 0)?,
        // A library of geometry without a scene.
        None => {
            for geometry in root.descendants().filter(|n| n.tag_name().name() == "geometry") {
                reader.geometry(geometry, metres)?;
            }
        }
    }
    Ok(reader.mesh)
}

fn child<'a, 'i>(node: Node<'a, 'i>, name: &str) -> Option<Node<'a, 'i>> {
    children(node, name).next()
}

fn children<'a, 'i>(node: Node<'a, 'i>, name: &str) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(move |c| c.tag_name().name() == name)
}

/// Where an element is, for messages.
fn place(node: Node) -> String {
    let at = node.document().text_pos_at(node.range().start);
    format!("line {}, <{}>", at.row, node.tag_name().name())
}

/// All text of an element; comments may divide it.
fn text(node: Node) -> String {
    node.children().filter(Node::is_text).filter_map(|t| t.text()).collect::<Vec<&str>>().join(" ")
}

fn numbers<T: std::str::FromStr>(node: Node) -> Result<Vec<T>> {
    text(node)
        .split_ascii_whitespace()
        .map(|word| {
            word.parse()
                .ok()
                .with_context(|| format!("{}: '{word}' is not a number of this list", place(node)))
        })
        .collect()
}

fn attribute<T: std::str::FromStr>(node: Node, name: &str, default: Option<T>) -> Result<T> {
    match (node.attribute(name), default) {
        (Some(value), _) => value
            .trim()
            .parse()
            .ok()
            .with_context(|| format!("{}: {name}=\"{value}\" is not a number", place(node))),
        (None, Some(default)) => Ok(default),
        (None, None) => bail!("{}: has no {name}", place(node)),
    }
}

struct Reader<'a, 'i> {
    by_id: HashMap<&'a str, Node<'a, 'i>>,
    mesh: Mesh,
}

/// Vertices as indices of a source of positions.
struct Positions {
    points: Vec<DVec3>,
}

impl<'a, 'i> Reader<'a, 'i> {
    fn target(&self, node: Node<'a, 'i>, attribute: &str) -> Result<Node<'a, 'i>> {
        let url =
            node.attribute(attribute).with_context(|| format!("{}: has no {attribute}", place(node)))?;
        let id = url.strip_prefix('#').with_context(|| {
            format!("{}: refers to {url}; only what is in the same file can be read", place(node))
        })?;
        self.by_id.get(id).copied().with_context(|| format!("{}: the file has no {url}", place(node)))
    }

    /// The nodes below `parent`, which is at `to_metres`.
    fn nodes(&mut self, parent: Node<'a, 'i>, to_metres: DMat4, depth: usize) -> Result<()> {
        if depth > MAX_DEPTH {
            bail!("{}: nodes contain themselves, or are nested more than {MAX_DEPTH} deep", place(parent));
        }
        for node in parent.children().filter(Node::is_element) {
            match node.tag_name().name() {
                "node" => self.nodes(node, to_metres * transform(node)?, depth + 1)?,
                "instance_node" => {
                    let target = self.target(node, "url")?;
                    self.nodes(target, to_metres * transform(target)?, depth + 1)?;
                }
                "instance_geometry" => {
                    let geometry = self.target(node, "url")?;
                    self.geometry(geometry, to_metres)?;
                }
                "instance_controller" => bail!(
                    "{}: shows a mesh through a skin or a morph, which is not supported; export the mesh as STL",
                    place(node)
                ),
                _ => {}
            }
        }
        Ok(())
    }

    fn geometry(&mut self, geometry: Node<'a, 'i>, to_metres: DMat4) -> Result<()> {
        let Some(mesh) = child(geometry, "mesh") else {
            bail!(
                "{}: has no <mesh>; splines and convex hulls are not supported, export it as STL",
                place(geometry)
            );
        };
        for primitive in mesh.children().filter(Node::is_element) {
            let name = primitive.tag_name().name();
            if !matches!(name, "triangles" | "polylist" | "polygons" | "trifans" | "tristrips") {
                continue;
            }
            let Some(corners) = self.corners(primitive)? else { continue };
            let triangles = triangles(primitive, &corners)?;
            let points = corners.positions.points.iter().map(|p| to_metres.transform_point3(*p)).collect();
            let part = Mesh::new(points, triangles)
                .with_context(|| format!("{}: invalid mesh", place(primitive)))?;
            self.mesh.add(&part);
            if self.mesh.triangles().len() > MAX_TRIANGLES {
                bail!("the scene shows more than {MAX_TRIANGLES} triangles");
            }
        }
        Ok(())
    }

    /// Where a primitive's vertices come from; `None` without any.
    fn corners(&self, primitive: Node<'a, 'i>) -> Result<Option<Corners>> {
        let mut stride = 0;
        let mut vertex = None;
        for input in children(primitive, "input") {
            let offset: usize = attribute(input, "offset", Some(0))?;
            if offset > 64 {
                bail!("{}: offset {offset} is out of range 0..=64", place(input));
            }
            stride = stride.max(offset + 1);
            if input.attribute("semantic") == Some("VERTEX") {
                vertex = Some(Vertex { offset, input });
            }
        }
        let Some(Vertex { offset, input }) = vertex else { return Ok(None) };
        let vertices = self.target(input, "source")?;
        let position = children(vertices, "input")
            .find(|i| i.attribute("semantic") == Some("POSITION"))
            .with_context(|| format!("{}: has no POSITION", place(vertices)))?;
        Ok(Some(Corners { stride, offset, positions: self.positions(self.target(position, "source")?)? }))
    }

    fn positions(&self, source: Node<'a, 'i>) -> Result<Positions> {
        let accessor = child(source, "technique_common")
            .and_then(|t| child(t, "accessor"))
            .with_context(|| format!("{}: has no <accessor>", place(source)))?;
        let array = self.target(accessor, "source")?;
        let values: Vec<f64> = numbers(array)?;
        let count: usize = attribute(accessor, "count", None)?;
        let offset: usize = attribute(accessor, "offset", Some(0))?;
        let stride: usize = attribute(accessor, "stride", Some(1))?;
        let needed = count
            .checked_sub(1)
            .map_or(Some(0), |n| n.checked_mul(stride)?.checked_add(offset)?.checked_add(3));
        if stride < 3 || needed.is_none_or(|n| n > values.len()) {
            bail!("{}: {count} points do not fit into {} numbers", place(accessor), values.len());
        }
        let points = (0..count).map(|i| DVec3::from_slice(&values[offset + i * stride..])).collect();
        Ok(Positions { points })
    }
}

struct Vertex<'a, 'i> {
    offset: usize,
    input: Node<'a, 'i>,
}

/// How a primitive lists its vertices.
struct Corners {
    /// Indices for each vertex.
    stride: usize,
    /// The one of them that is the position's.
    offset: usize,
    positions: Positions,
}

impl Corners {
    /// The indices of positions in a list.
    fn list(&self, p: Node) -> Result<Vec<u32>> {
        let all: Vec<u32> = numbers(p)?;
        if !all.len().is_multiple_of(self.stride) {
            bail!("{}: {} indices, {} for each vertex", place(p), all.len(), self.stride);
        }
        Ok(all.chunks_exact(self.stride).map(|vertex| vertex[self.offset]).collect())
    }
}

/// Triangles of a primitive; polygons are divided into fans.
fn triangles(primitive: Node, corners: &Corners) -> Result<Vec<[u32; 3]>> {
    let mut triangles = Vec::new();
    let fan = |polygon: &[u32], into: &mut Vec<[u32; 3]>| {
        into.extend(polygon.windows(2).skip(1).map(|edge| [polygon[0], edge[0], edge[1]]));
    };
    match primitive.tag_name().name() {
        "triangles" => {
            for p in children(primitive, "p") {
                let list = corners.list(p)?;
                if !list.len().is_multiple_of(3) {
                    bail!("{}: {} vertices are no triangles", place(p), list.len());
                }
                triangles.extend(list.chunks_exact(3).map(|t| [t[0], t[1], t[2]]));
            }
        }
        "polylist" => {
            let (Some(counts), Some(p)) = (child(primitive, "vcount"), child(primitive, "p")) else {
                return Ok(triangles);
            };
            let list = corners.list(p)?;
            let mut rest = list.as_slice();
            for count in numbers::<usize>(counts)? {
                let Some(polygon) = rest.get(..count) else {
                    bail!("{}: its polygons have more vertices than there are in <p>", place(counts));
                };
                fan(polygon, &mut triangles);
                rest = &rest[count..];
            }
        }
        "tristrips" => {
            for p in children(primitive, "p") {
                triangles.extend(corners.list(p)?.windows(3).map(|t| [t[0], t[1], t[2]]));
            }
        }
        // <polygons> and <trifans>; polygons with holes are filled.
        _ => {
            let with_holes = children(primitive, "ph").filter_map(|ph| child(ph, "p"));
            for p in children(primitive, "p").chain(with_holes) {
                fan(&corners.list(p)?, &mut triangles);
            }
        }
    }
    Ok(triangles)
}

/// A node's own transform: its elements in their order, the first one outermost.
fn transform(node: Node) -> Result<DMat4> {
    let mut all = DMat4::IDENTITY;
    for element in node.children().filter(Node::is_element) {
        let name = element.tag_name().name();
        let wanted = match name {
            "matrix" => 16,
            "rotate" => 4,
            "translate" | "scale" => 3,
            "lookat" | "skew" => bail!("{}: is not supported; export the mesh as STL", place(element)),
            _ => continue,
        };
        let v: Vec<f64> = numbers(element)?;
        if v.len() != wanted || v.iter().any(|n| !n.is_finite()) {
            bail!("{}: needs {wanted} finite numbers, has {}", place(element), v.len());
        }
        all *= match name {
            // Written row by row.
            "matrix" => DMat4::from_cols_slice(&v).transpose(),
            "translate" => DMat4::from_translation(DVec3::from_slice(&v)),
            "scale" => DMat4::from_scale(DVec3::from_slice(&v)),
            _ => match DVec3::from_slice(&v).try_normalize() {
                Some(axis) => DMat4::from_axis_angle(axis, v[3].to_radians()),
                None => DMat4::IDENTITY,
            },
        };
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file with one triangle, or what stands in its place.
    fn file(unit: &str, primitive: &str, scene: &str) -> String {
        format!(
            r##"<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset>{unit}<up_axis>Y_UP</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="s"><float_array id="a" count="13">9 0 0 0 1 0 0 0 <!-- divided --> 1 0 1 1 0</float_array>
      <technique_common><accessor source="#a" count="4" offset="1" stride="3"/></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
    {primitive}
  </mesh></geometry></library_geometries>
  <library_nodes><node id="n"><translate>0 0 5</translate><instance_geometry url="#g"/></node></library_nodes>
  <library_visual_scenes><visual_scene id="w">{scene}</visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#w"/></scene>
</COLLADA>"##
        )
    }

    const TRIANGLE: &str = r##"<triangles count="1"><input semantic="NORMAL" source="#x" offset="0"/><input semantic="VERTEX" source="#v" offset="1"/><p>7 0 8 1 9 2</p></triangles>"##;
    const METRE: &str = r#"<unit meter="1"/>"#;

    fn corners(text: &str) -> Vec<DVec3> {
        let mesh = read(text).unwrap();
        mesh.triangles().iter().flatten().map(|i| mesh.vertices()[*i as usize]).collect()
    }

    fn close(found: &[DVec3], wanted: &[[f64; 3]]) {
        assert_eq!(found.len(), wanted.len(), "{found:?}");
        for (f, w) in found.iter().zip(wanted) {
            assert!(f.distance(DVec3::from_array(*w)) < 1e-9, "{found:?} {wanted:?}");
        }
    }

    #[test]
    fn small_translations_count() {
        let scene = r##"<node><matrix>1 0 0 0 0 1 0 0.003 0 0 1 0 0 0 0 1</matrix><instance_geometry url="#g"/></node>"##;
        close(
            &corners(&file(METRE, TRIANGLE, scene)),
            &[[0.0, 0.003, 0.0], [1.0, 0.003, 0.0], [0.0, 1.003, 0.0]],
        );
    }

    #[test]
    fn the_outer_transform_is_applied_last_and_the_unit_to_all() {
        // Turned about z, moved along the turned x axis; the inner node moves before both.
        let scene = r##"<node><rotate>0 0 1 90</rotate><translate>10 0 0</translate>
            <node><scale>2 2 2</scale><instance_geometry url="#g"/></node></node>"##;
        let text = file(r#"<unit name="centimeter" meter="0.01"/>"#, TRIANGLE, scene);
        close(&corners(&text), &[[0.0, 0.1, 0.0], [0.0, 0.12, 0.0], [-0.02, 0.1, 0.0]]);
    }

    #[test]
    fn geometry_that_is_shown_twice_is_there_twice_and_what_is_not_shown_is_not() {
        let scene = r##"<node><instance_geometry url="#g"/></node><instance_node url="#n"/>"##;
        let found = corners(&file(METRE, TRIANGLE, scene));
        assert_eq!(found.len(), 6);
        assert_eq!(found[3], DVec3::new(0.0, 0.0, 5.0));
        assert!(read(&file(METRE, TRIANGLE, "<node/>")).unwrap().triangles().is_empty());
        let without_scene = file(METRE, TRIANGLE, "")
            .replace("<scene><instance_visual_scene url=\"#w\"/></scene>", "")
            .replace("visual_scene", "other");
        assert_eq!(corners(&without_scene).len(), 3);
    }

    #[test]
    fn polygons_fans_and_strips_are_triangles() {
        let shown = r##"<node><instance_geometry url="#g"/></node>"##;
        let of = |primitive: &str| {
            let input = r##"<input semantic="VERTEX" source="#v" offset="0"/>"##;
            let mesh = read(&file(METRE, &primitive.replace("INPUT", input), shown)).unwrap();
            mesh.triangles().to_vec()
        };
        assert_eq!(
            of("<polylist>INPUT<vcount>4 3</vcount><p>0 1 3 2 0 1 2</p></polylist>"),
            [[0, 1, 3], [0, 3, 2], [0, 1, 2]]
        );
        assert_eq!(
            of("<polygons>INPUT<p>0 1 3 2</p><p>0 1 2</p></polygons>"),
            [[0, 1, 3], [0, 3, 2], [0, 1, 2]]
        );
        assert_eq!(of("<trifans>INPUT<p>0 1 3 2</p></trifans>"), [[0, 1, 3], [0, 3, 2]]);
        assert_eq!(of("<tristrips>INPUT<p>0 1 2 3</p></tristrips>"), [[0, 1, 2], [1, 2, 3]]);
        assert!(of("<lines>INPUT<p>0 1</p></lines>").is_empty());
    }

    #[test]
    fn damaged_files_are_refused_with_the_line() {
        let shown = r##"<node><instance_geometry url="#g"/></node>"##;
        let of = |text: &str| format!("{:#}", read(text).unwrap_err());
        let good = file(METRE, TRIANGLE, shown);
        assert!(of("<COLLADA>").contains("invalid XML"));
        assert!(of("<robot/>").contains("<robot>, not <COLLADA>"));
        assert!(of(&good.replace("9 2<", "9 4<")).contains("line 8, <triangles>: invalid mesh"));
        assert!(of(&good.replace("9 2<", "9<")).contains("5 indices, 2 for each vertex"));
        assert!(of(&good.replace("9 2<", "9 -2<")).contains("'-2' is not a number of this list"));
        assert!(
            of(&good.replace("count=\"4\"", "count=\"5\"")).contains("5 points do not fit into 13 numbers")
        );
        assert!(of(&good.replace("count=\"4\"", "count=\"18446744073709551615\"")).contains("do not fit"));
        assert!(of(&good.replace("meter=\"1\"", "meter=\"0\"")).contains("not positive"));
        assert!(
            of(&good.replace("url=\"#g\"/></node></vis", "url=\"#h\"/></node></vis"))
                .contains("the file has no #h")
        );
        let circle = good.replace("<translate>0 0 5</translate>", "<instance_node url=\"#n\"/>");
        assert!(
            of(&circle.replace("<node><inst", "<node><instance_node url=\"#n\"/><inst"))
                .contains("contain themselves")
        );
        let skin = file(METRE, TRIANGLE, r##"<node><instance_controller url="#c"/></node>"##);
        assert!(of(&skin).contains("export the mesh as STL"));
        let short = file(METRE, TRIANGLE, "<node><translate>1 2</translate></node>");
        assert!(of(&short).contains("needs 3 finite numbers, has 2"));
    }
}
