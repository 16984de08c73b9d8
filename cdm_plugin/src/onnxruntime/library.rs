//! Finds the library of ONNX Runtime and looks at it before it is used.
//!
//! `ort` panics in places when a library is not what it should be, and the loader of the system ends the process with
//! a bus error when a file is cut short. Hence everything that can be known is asked here first.
// Loading a library and asking for its version are calls into foreign code.
#![allow(unsafe_code)]

mod python;

use super::device::Device;
use crate::{Error, ErrorKind, Result};
use core::ffi::{CStr, c_char, c_void};
use std::ffi::OsStr;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// The oldest minor version of ONNX Runtime 1.x whose interface is known to `ort` as it is built here.
pub const OLDEST_MINOR: u32 = ort::MINOR_VERSION;
/// The variable that names the library, as `ort` and its documentation have it.
pub const VARIABLE: &str = "ORT_DYLIB_PATH";
/// The folder beside the program, and within folders of data, that `tools/onnxruntime.sh` fills.
const FOLDER: &str = "onnxruntime";
/// Where distributions and people put libraries.
const SYSTEM: [&str; 8] = [
    "/usr/local/lib/depthrig/onnxruntime",
    "/opt/onnxruntime/lib",
    "/usr/local/lib",
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/lib64",
];

/// The library that was found: the one asked for, else the first that is there.
///
/// `wanted` and `variable` (of the environment) may be the file or a folder that holds it.
///
/// # Errors
/// [`ErrorKind::NoEngine`] when no library is found, with what to install.
pub fn find(wanted: Option<&Path>, variable: Option<&OsStr>, device: &Device) -> Result<PathBuf> {
    if let Some(path) = wanted {
        return inside(path)
            .ok_or_else(|| missing(&format!("{} is set as the library", path.display()), device));
    }
    if let Some(path) = variable.filter(|v| !v.is_empty()).map(Path::new) {
        return inside(path).ok_or_else(|| missing(&format!("${VARIABLE} is {}", path.display()), device));
    }
    let folders = places(device);
    folders
        .iter()
        .find_map(|folder| inside(folder))
        .ok_or_else(|| missing("neither the settings nor the usual places name one", device))
}

fn missing(what: &str, device: &Device) -> Error {
    let package = device.package();
    let message = format!(
        "ONNX Runtime was not found: {what}, and no libonnxruntime.so is there. In a checkout run \
         `tools/onnxruntime.sh {variant}`; elsewhere `pip install {package}` into the Python environment of depthrig, or \
         into any other and set {VARIABLE} or the setting `library` to its folder onnxruntime/capi",
        variant = device.variants()[0],
    );
    Error::new(ErrorKind::NoEngine, message)
}

/// Every folder to look into, best first.
fn places(device: &Device) -> Vec<PathBuf> {
    let mut roots: Vec<PathBuf> = Vec::new();
    let mut installed: Vec<PathBuf> = Vec::new();
    // `target/onnxruntime` for the programs and tests of a checkout; `/usr/local/bin/onnxruntime` of an installed one
    // does no harm.
    if let Ok(program) = std::env::current_exe() {
        roots.extend(program.ancestors().skip(1).take(3).map(|a| a.join(FOLDER)));
        installed = python::folders(&program);
    }
    let home = || std::env::var_os("HOME").map(|h| PathBuf::from(h).join(".local/share"));
    let data = std::env::var_os("XDG_DATA_HOME").filter(|v| !v.is_empty()).map(PathBuf::from).or_else(home);
    roots.extend(data.map(|d| d.join("depthrig").join(FOLDER)));
    roots.push("/var/lib/depthrig/onnxruntime".into());
    let mut folders: Vec<PathBuf> =
        device.variants().iter().flat_map(|v| roots.iter().map(move |r| r.join(v))).collect();
    folders.extend(installed);
    folders.extend(roots);
    folders.extend(SYSTEM.map(PathBuf::from));
    folders
}

/// The library at `path`: itself, or the one of highest version in that folder.
fn inside(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.into());
    }
    let version = |name: &str| -> Option<Vec<u32>> {
        let rest = name.strip_prefix("libonnxruntime.so")?;
        rest.split('.').skip(1).map(|n| n.parse().ok()).collect()
    };
    let entries = std::fs::read_dir(path).ok()?;
    entries
        .flatten()
        .filter_map(|e| Some((version(e.file_name().to_str()?)?, e.path())))
        .filter(|(_, path)| path.is_file())
        .max()
        .map(|(_, path)| path)
}

/// Loads the library at `path` and asks for its version, such as `1.31.1`.
///
/// # Errors
/// [`ErrorKind::NoEngine`] for a file that is damaged, not ONNX Runtime, or of an unsupported version.
pub fn version(path: &Path) -> Result<String> {
    let refuse = |what: String| {
        let message = format!(
            "{}: {what}. ONNX Runtime 1.{OLDEST_MINOR} or a later 1.x is needed: run `tools/onnxruntime.sh` in a \
             checkout, or `pip install onnxruntime`",
            path.display()
        );
        Error::new(ErrorKind::NoEngine, message)
    };
    check_complete(path).map_err(|what| refuse(what.into()))?;

    // SAFETY: the file is a complete library (checked above), named by who runs this program or found where programs
    // are installed; its initialisers run, as they would if this program were linked to it.
    let library = unsafe { libloading::Library::new(path) }
        .map_err(|e| refuse(format!("cannot be loaded: {}", cause(&e))))?;
    // SAFETY: a library with this symbol is ONNX Runtime, of which every version has this function with this type
    // (onnxruntime_c_api.h, MIT).
    let base = unsafe { library.get::<unsafe extern "C" fn() -> *const ApiBase>(b"OrtGetApiBase\0") }
        .map_err(|_| refuse("is a library, but not ONNX Runtime".into()))?;
    // SAFETY: it takes nothing and gives a pointer to a constant, or null.
    let base = unsafe { base().as_ref() }.ok_or_else(|| refuse("gives no interface".into()))?;
    // SAFETY: the second function of that constant gives a string that lives as long as the library.
    let text = unsafe { (base.version)() };
    if text.is_null() {
        return Err(refuse("does not report its version".into()));
    }
    // SAFETY: it is not null and ends with a zero byte; the library is still loaded.
    let text = unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned();
    let mut numbers = text.split('.').map(str::parse::<u32>);
    match (numbers.next(), numbers.next()) {
        (Some(Ok(1)), Some(Ok(minor))) if minor >= OLDEST_MINOR => {}
        (Some(Ok(1)), Some(Ok(_))) => return Err(refuse(format!("is version {text}, which is too old"))),
        _ => return Err(refuse(format!("says that it is version {text:?}"))),
    }
    // Unloading a library that has started threads ends badly, and `ort` is about to load it again anyway.
    core::mem::forget(library);
    Ok(text)
}

/// The words of the system's loader, which the error itself leaves out.
pub(super) fn cause(error: &libloading::Error) -> String {
    core::error::Error::source(error).map_or_else(|| error.to_string(), ToString::to_string)
}

/// `OrtApiBase`, onnxruntime_c_api.h.
#[repr(C)]
struct ApiBase {
    api: unsafe extern "C" fn(u32) -> *const c_void,
    version: unsafe extern "C" fn() -> *const c_char,
}

/// Whether every part of a 64-bit ELF file that is to be mapped is there.
fn check_complete(path: &Path) -> Result<(), &'static str> {
    const CUT: &str = "is cut short";
    let file = depthrig_bus::files::open(path).map_err(|_| "cannot be read")?;
    let length = file.metadata().map_err(|_| "cannot be read")?.len();
    let mut head = [0u8; 64];
    file.read_exact_at(&mut head, 0).map_err(|_| CUT)?;
    if head[..5] != *b"\x7fELF\x02" {
        return Err("is not a library of this kind of computer");
    }
    let u16_at = |b: &[u8], at: usize| u64::from(u16::from_le_bytes([b[at], b[at + 1]]));
    let u64_at = |b: &[u8], at: usize| {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&b[at..at + 8]);
        u64::from_le_bytes(bytes)
    };
    // e_phoff, e_phentsize, e_phnum of the header; p_offset and p_filesz of each program header.
    let table = u64_at(&head, 32);
    let size = u16_at(&head, 54);
    let count = u16_at(&head, 56);
    if size < 56 {
        return Err("has a damaged header");
    }
    for i in 0..count {
        let mut part = [0u8; 56];
        let at = table.checked_add(i * size).ok_or("has a damaged header")?;
        file.read_exact_at(&mut part, at).map_err(|_| CUT)?;
        let end = u64_at(&part, 8).checked_add(u64_at(&part, 32)).ok_or("has a damaged header")?;
        if end > length {
            return Err(CUT);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
