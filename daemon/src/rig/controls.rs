//! Controls of running cameras: listed, changed, and written back into the rig file.

use super::Inner;
use crate::camera::Camera;
use crate::config::RigConfig;
use crate::control::{CameraControls, ControlChanges, ControlInfo, ControlItem, ControlList, ControlRequest};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::sync::lock;
use depthrig_driver::controls::{ControlKind, ControlPanel, ControlState, ControlValue};
use similar::TextDiff;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use toml_edit::{DocumentMut, Item, Table, Value};

/// Lines around a change that a diff shows.
const DIFF_CONTEXT: usize = 3;

pub(super) fn list(rig: &Inner) -> Result<ControlList> {
    let file = rig.config.path.clone();
    let document = file.as_deref().map(|path| read(path).and_then(|text| parse(path, &text))).transpose()?;
    let cameras = rig.cameras.iter().map(|camera| of_camera(camera, document.as_ref())).collect();
    Ok(ControlList { file, cameras })
}

pub(super) fn set(rig: &Inner, request: &ControlRequest) -> Result<CameraControls> {
    let camera = find(rig, &request.camera)?;
    let panel = panel(camera)?;
    change(rig, camera, &*panel, &request.name, &request.value)?;
    lock(&camera.changed).insert(request.name.clone(), request.value.clone());
    one(rig, camera)
}

pub(super) fn revert(rig: &Inner, camera: &str) -> Result<CameraControls> {
    let camera = find(rig, camera)?;
    let panel = panel(camera)?;
    let path = rig.config.path.as_deref();
    let document = path.map(|path| read(path).and_then(|text| parse(path, &text))).transpose()?;
    let states = panel.list()?;
    let changed: Vec<String> = lock(&camera.changed).keys().cloned().collect();
    // Automatics last: while one is on, what it holds cannot be written.
    let (automatics, others): (Vec<_>, Vec<_>) = changed.into_iter().partition(|key| key.contains("auto"));
    for key in others.into_iter().chain(automatics) {
        let in_file = document.as_ref().and_then(|d| in_file(d, camera.config.name.as_str(), &key));
        let default = || states.iter().find(|s| s.key == key).and_then(default_of);
        if let Some(value) = in_file.or_else(default) {
            change(rig, camera, &*panel, &key, &value)?;
        }
        lock(&camera.changed).remove(&key);
    }
    one(rig, camera)
}

pub(super) fn changes(rig: &Inner) -> Result<ControlChanges> {
    Ok(Edit::of(rig)?.changes)
}

pub(super) fn save(rig: &Inner, fingerprint: &str) -> Result<ControlChanges> {
    let edit = Edit::of(rig)?;
    if edit.changes.fingerprint != fingerprint {
        let what = "the rig file or a control has changed since; look at the change again";
        return Err(Error::new(ErrorKind::WrongState, what));
    }
    if !edit.changes.diff.is_empty() {
        replace(&edit.changes.file, &edit.after)?;
        tracing::info!(file = %edit.changes.file.display(), "changed controls were written into the rig file");
    }
    Ok(edit.changes)
}

/// A line for a recording that begins; `None` when the rig file says it all.
pub(super) fn note(rig: &Inner) -> Option<String> {
    let changed: Vec<_> = rig
        .cameras
        .iter()
        .flat_map(|camera| {
            let name = camera.config.name.as_str();
            lock(&camera.changed).iter().map(|(key, value)| text(name, key, value)).collect::<Vec<_>>()
        })
        .collect();
    (!changed.is_empty()).then(|| format!("controls changed before: {}", changed.join(", ")))
}

fn text(camera: &str, key: &str, value: &ControlValue) -> String {
    format!("{camera}.{key} = {value}")
}

fn find<'r>(rig: &'r Inner, name: &str) -> Result<&'r Arc<Camera>> {
    rig.cameras.iter().find(|c| c.config.name.as_str() == name).ok_or_else(|| {
        let names: Vec<_> = rig.cameras.iter().map(|c| c.config.name.as_str()).collect();
        let what = format!("no camera is called {name:?}; there are: {}", names.join(", "));
        Error::new(ErrorKind::NotFound, what)
    })
}

fn panel(camera: &Camera) -> Result<Arc<dyn ControlPanel>> {
    let state = camera.state();
    let name = camera.config.name.as_str();
    let fixed = || {
        let what = format!(
            "camera \"{name}\" takes its controls from the rig file when it is opened, and none later"
        );
        Error::new(ErrorKind::WrongState, what)
    };
    let away = || {
        let what = format!("camera \"{name}\" is not open now; its controls can be changed when it streams");
        Error::new(ErrorKind::WrongState, what)
    };
    if state.info.is_none() {
        return Err(away());
    }
    state.panel.as_ref().ok_or_else(fixed)?.upgrade().ok_or_else(away)
}

fn change(
    rig: &Inner,
    camera: &Camera,
    panel: &dyn ControlPanel,
    key: &str,
    value: &ControlValue,
) -> Result<()> {
    let name = camera.config.name.as_str();
    panel.set(key, value)?;
    tracing::info!(camera = name, "{key} set to {value}");
    let mut recording = lock(&rig.recording);
    if recording.is_active() {
        recording.note(&format!("control changed: {}", text(name, key, value)))?;
    }
    Ok(())
}

fn one(rig: &Inner, camera: &Camera) -> Result<CameraControls> {
    let path = rig.config.path.as_deref();
    let document = path.map(|path| read(path).and_then(|text| parse(path, &text))).transpose()?;
    Ok(of_camera(camera, document.as_ref()))
}

fn of_camera(camera: &Camera, file: Option<&DocumentMut>) -> CameraControls {
    let name = camera.config.name.as_str();
    let listed = panel(camera).and_then(|panel| Ok(panel.list()?));
    let (controls, problem) = match listed {
        Ok(states) => (states, None),
        Err(e) => (Vec::new(), Some(e.to_string())),
    };
    let controls = controls.into_iter().filter_map(|state| {
        let in_file = file.and_then(|file| in_file(file, name, &state.key));
        info(state, in_file)
    });
    CameraControls { camera: name.to_owned(), problem, controls: controls.collect() }
}

fn info(state: ControlState, in_file: Option<ControlValue>) -> Option<ControlInfo> {
    let kind = match state.control.kind {
        ControlKind::Boolean => "boolean",
        ControlKind::Menu | ControlKind::IntegerMenu => "menu",
        ControlKind::Integer | ControlKind::Integer64 | ControlKind::Bitmask => "integer",
        ControlKind::Button | ControlKind::Other => return None,
    };
    let value = state.file_value();
    let default = default_of(&state);
    let c = state.control;
    Some(ControlInfo {
        name: state.key,
        kind,
        minimum: c.minimum,
        maximum: c.maximum,
        step: c.step.max(1),
        default,
        items: c.items.into_iter().map(|(value, name)| ControlItem { value, name }).collect(),
        value,
        in_file,
        is_active: !c.inactive,
        is_read_only: c.read_only,
    })
}

fn default_of(state: &ControlState) -> Option<ControlValue> {
    ControlState { value: Some(state.control.default), ..state.clone() }.file_value()
}

fn read(path: &Path) -> Result<String> {
    depthrig_bus::files::read_to_string(path, depthrig_bus::files::TEXT_MAX_BYTES).map_err(|e| {
        Error::new(ErrorKind::Other, format!("rig file {} cannot be read: {e}", path.display()))
            .with_source(e)
    })
}

fn parse(path: &Path, text: &str) -> Result<DocumentMut> {
    text.parse().map_err(|e: toml_edit::TomlError| {
        let what = format!("rig file {} is not valid TOML any more: {}", path.display(), e.message());
        Error::new(ErrorKind::Other, what).with_source(e)
    })
}

/// The value of a control in a rig file.
fn in_file(document: &DocumentMut, camera: &str, key: &str) -> Option<ControlValue> {
    let is_it = |table: &&Table| table.get("name").and_then(Item::as_str) == Some(camera);
    let table = document.get("camera")?.as_array_of_tables()?.iter().find(is_it)?;
    let mut item = table.get(key.split('.').next()?)?;
    for part in key.split('.').skip(1) {
        item = item.as_table_like()?.get(part)?;
    }
    match item.as_value()? {
        Value::Integer(v) => Some(ControlValue::Integer(*v.value())),
        Value::Boolean(v) => Some(ControlValue::Boolean(*v.value())),
        Value::String(v) => Some(ControlValue::Item(v.value().clone())),
        _ => None,
    }
}

/// A change of the rig file.
struct Edit {
    changes: ControlChanges,
    after: String,
}

impl Edit {
    fn of(rig: &Inner) -> Result<Self> {
        let none = || {
            let what = "this rig runs without a file; write one with: depthrig config show > rig.toml";
            Error::new(ErrorKind::WrongState, what)
        };
        let path = rig.config.path.as_deref().ok_or_else(none)?;
        // A link stays one: the file behind it is replaced.
        let file = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        let before = read(&file)?;
        let mut document = parse(&file, &before)?;
        for camera in &rig.cameras {
            for (key, value) in lock(&camera.changed).iter() {
                let name = camera.config.name.as_str();
                if in_file(&document, name, key).as_ref() != Some(value) {
                    write(&mut document, name, key, value, &file)?;
                }
            }
        }
        let after = document.to_string();
        RigConfig::parse(&after, Some(path)).map_err(|e| {
            let what = format!("{} would not be a valid rig file with these controls: {e}", file.display());
            Error::new(ErrorKind::Other, what)
        })?;
        Ok(Self { changes: of_texts(file, &before, &after), after })
    }
}

fn of_texts(file: PathBuf, before: &str, after: &str) -> ControlChanges {
    let shown = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let diff = TextDiff::from_lines(before, after);
    let diff = if before == after {
        String::new()
    } else {
        diff.unified_diff().context_radius(DIFF_CONTEXT).header(&shown, &shown).to_string()
    };
    let fingerprint =
        format!("{:08x}{:08x}", crc32fast::hash(before.as_bytes()), crc32fast::hash(after.as_bytes()));
    ControlChanges { file, diff, fingerprint }
}

/// Sets a control in a rig file; comments and order stay.
fn write(
    document: &mut DocumentMut,
    camera: &str,
    key: &str,
    value: &ControlValue,
    file: &Path,
) -> Result<()> {
    let by_hand = || {
        let what = format!(
            "{}: camera \"{camera}\" is not a [[camera]] table there; write {key} = {value} by hand",
            file.display()
        );
        Error::new(ErrorKind::Other, what)
    };
    let cameras = document.get_mut("camera").and_then(Item::as_array_of_tables_mut).ok_or_else(by_hand)?;
    let is_it = |table: &&mut Table| table.get("name").and_then(Item::as_str) == Some(camera);
    let table = cameras.iter_mut().find(is_it).ok_or_else(by_hand)?;
    let new = match value {
        ControlValue::Integer(v) => Value::from(*v),
        ControlValue::Boolean(v) => Value::from(*v),
        ControlValue::Item(v) => Value::from(v),
    };
    let place: &mut dyn toml_edit::TableLike = match key.split_once('.') {
        None => table,
        Some((inner, _)) => {
            let inner = table.entry(inner).or_insert_with(toml_edit::table);
            inner.as_table_like_mut().ok_or_else(by_hand)?
        }
    };
    let last = key.rsplit('.').next().unwrap_or(key);
    match place.get_mut(last).and_then(Item::as_value_mut) {
        // Spaces and comments around a value are kept with it.
        Some(old) => {
            let decor = old.decor().clone();
            *old = new;
            *old.decor_mut() = decor;
        }
        None => drop(place.insert(last, Item::Value(new))),
    }
    Ok(())
}

/// Replaces a file in one step; it keeps its permissions.
fn replace(path: &Path, text: &str) -> Result<()> {
    let failed = |e: std::io::Error| {
        let kind = match e.kind() {
            std::io::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
            std::io::ErrorKind::StorageFull => ErrorKind::NoSpace,
            _ => ErrorKind::Other,
        };
        let what = format!("rig file {} cannot be written and is as before: {e}", path.display());
        Error::new(kind, what).with_source(e)
    };
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut file = tempfile::NamedTempFile::new_in(folder).map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)?;
    let permissions = std::fs::metadata(path).map_err(failed)?.permissions();
    file.as_file().set_permissions(permissions).map_err(failed)?;
    file.as_file().sync_all().map_err(failed)?;
    file.persist(path).map_err(|e| failed(e.error))?;
    Ok(())
}

#[cfg(test)]
mod tests;
