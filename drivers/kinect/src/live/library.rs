//! Finds libk4a and the depth engine, and loads them once for good.
//!
//! Both are Microsoft's and come in one package, `libk4a1.4`; neither is needed to build. libk4a looks for the engine
//! by its bare name when the first camera starts depth, so that an engine which lies elsewhere is loaded here before:
//! the loader of the system then finds it by its name.
// Loading a library runs its initialisers, and its functions can only be promised.
#![allow(unsafe_code)]

use super::ffi::{self, Functions};
use super::journal::{Journal, on_message};
use depthrig_bus::sync::lock;
use depthrig_driver::{Error, ErrorKind, Result};
use libloading::Library;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// The environment variable that names libk4a: the file, or the folder that holds it.
pub const VARIABLE: &str = "DEPTHRIG_LIBK4A";
/// File name of the library, without its version.
const LIBRARY: &str = "libk4a.so";
/// The file that libk4a 1.4 asks the loader for (`dynlib_linux.c`, `k4aplugin.h`).
pub const ENGINE: &str = "libdepthengine.so.2.0";
/// Symbol of a depth engine (`k4aplugin.h`).
const ENGINE_SYMBOL: &[u8] = b"k4a_register_plugin\0";
/// Usual folders of libraries.
const SYSTEM: [&str; 7] = [
    "/usr/local/lib/depthrig/k4a",
    "/opt/k4a/lib",
    "/usr/local/lib",
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
];
/// Where the package has the engine, below the folder of libk4a.
const ENGINE_FOLDERS: [&str; 2] = ["", "libk4a1.4"];

/// How to get both, for messages.
pub const CURE: &str = "install the package libk4a1.4 of https://packages.microsoft.com (for Ubuntu 18.04; Debian has none): \
    it may also be unpacked with `dpkg-deb -x` into any folder, which `library` of the camera or the variable \
    DEPTHRIG_LIBK4A then names";

/// Where to look.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Places {
    /// The library, or its folder; `None`: what [`VARIABLE`] says, else the usual places.
    pub library: Option<PathBuf>,
    /// The depth engine, or its folder; `None`: beside the library, else the usual places.
    pub engine: Option<PathBuf>,
}

/// A loaded libk4a.
pub struct Loaded {
    /// Its functions.
    pub functions: Functions,
    /// The file.
    pub path: PathBuf,
    /// Its messages.
    pub journal: Journal,
    /// One opening at a time: it goes through all cameras, and each must be opened to be asked who it is.
    pub opening: Mutex<()>,
}

impl core::fmt::Debug for Loaded {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Loaded").field("path", &self.path).finish_non_exhaustive()
    }
}

/// The file of libk4a: the one asked for, else the first that is there.
///
/// # Errors
/// [`ErrorKind::BadInput`] if there is no such file, with what to install.
pub fn find(places: &Places) -> Result<PathBuf> {
    find_with(places, std::env::var_os(VARIABLE), &loader_folders())
}

fn find_with(places: &Places, variable: Option<OsString>, folders: &[PathBuf]) -> Result<PathBuf> {
    let missing = |what: String| {
        Error::new(ErrorKind::BadInput, format!("libk4a, which reads an Azure Kinect, {what}; {CURE}"))
    };
    if let Some(path) = &places.library {
        return inside(path).ok_or_else(|| missing(format!("is not at {}", path.display())));
    }
    if let Some(path) = variable.filter(|v| !v.is_empty()).map(PathBuf::from) {
        let what = || missing(format!("is not at {}, which ${VARIABLE} names", path.display()));
        return inside(&path).ok_or_else(what);
    }
    let found = folders.iter().find_map(|folder| inside(folder));
    found.ok_or_else(|| missing("is not installed".to_owned()))
}

/// Where the loader of the system looks, and the usual places.
fn loader_folders() -> Vec<PathBuf> {
    let mut folders: Vec<PathBuf> =
        std::env::var_os("LD_LIBRARY_PATH").map_or_else(Vec::new, |p| std::env::split_paths(&p).collect());
    folders.retain(|f| f.is_absolute());
    folders.extend(SYSTEM.map(PathBuf::from));
    folders
}

/// The library at `path`: itself, or the one of the highest version in that folder.
fn inside(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_owned());
    }
    let version = |name: &str| -> Option<Vec<u32>> {
        name.strip_prefix(LIBRARY)?.split('.').skip(1).map(|n| n.parse().ok()).collect()
    };
    let entries = std::fs::read_dir(path).ok()?;
    let found = entries.flatten().filter_map(|e| Some((version(e.file_name().to_str()?)?, e.path())));
    found.filter(|(_, path)| path.is_file()).max().map(|(_, path)| path)
}

/// Libraries that were loaded, by file. They stay: libk4a has threads of its own, and a camera may hang in it.
static LOADED: Mutex<BTreeMap<PathBuf, &'static Loaded>> = Mutex::new(BTreeMap::new());

/// The library that `places` mean, loaded.
///
/// # Errors
/// [`ErrorKind::BadInput`] if it is missing, cannot be loaded, or is not libk4a 1.4.
pub fn load(places: &Places) -> Result<&'static Loaded> {
    let path = find(places)?;
    let path = path.canonicalize().unwrap_or(path);
    let mut loaded = lock(&LOADED);
    if let Some(known) = loaded.get(&path) {
        return Ok(known);
    }
    let refuse =
        |what: String| Error::new(ErrorKind::BadInput, format!("{}: {what}; {CURE}", path.display()));
    // SAFETY: the file is named by who runs this program or lies where programs are installed; its initialisers run, as
    // they would if this program were linked to it.
    let library = unsafe { Library::new(&path) }.map_err(|e| refuse(format!("cannot be loaded: {e}")))?;
    // SAFETY: a library that has every one of these names is libk4a of 1.2 or later, whose interface is that of 1.4 as
    // far as it is used. It is never unloaded.
    let functions = unsafe { Functions::load(&library) }
        .map_err(|name| refuse(format!("has no {name}, so it is not libk4a 1.4")))?;
    core::mem::forget(library);
    let known: &'static Loaded = Box::leak(Box::new(Loaded {
        functions,
        path: path.clone(),
        journal: Journal::default(),
        opening: Mutex::new(()),
    }));
    let context = core::ptr::from_ref(&known.journal).cast_mut().cast();
    // SAFETY: the journal lives for good, and the handler calls nothing of libk4a. Without a handler libk4a writes to
    // our standard output.
    let is_heard =
        unsafe { (known.functions.set_debug_message_handler)(Some(on_message), context, ffi::LOG_WARNING) };
    if is_heard != ffi::SUCCEEDED {
        tracing::warn!(library = %path.display(), "libk4a gives its messages to other code in this process");
    }
    tracing::info!(library = %path.display(), "libk4a is loaded");
    loaded.insert(path, known);
    Ok(known)
}

/// The depth engine that a camera of the library at `library` would get; `None` says that the loader of the system
/// found it by its name.
///
/// # Errors
/// [`ErrorKind::BadInput`] when it is nowhere or cannot be loaded, with what to install.
pub fn load_engine(places: &Places, library: &Path) -> Result<Option<PathBuf>> {
    let explain = |what: String| {
        let text = format!(
            "the depth engine ({ENGINE}), without which a Kinect gives colour alone, {what}; {CURE}. Where the engine lies \
             apart from libk4a, `depth_engine` of the camera names it"
        );
        Error::new(ErrorKind::BadInput, text)
    };
    let at = |path: &Path| {
        let file = if path.is_dir() { path.join(ENGINE) } else { path.to_owned() };
        file.is_file().then_some(file)
    };
    let found = if let Some(path) = &places.engine {
        Some(at(path).ok_or_else(|| explain(format!("is not at {}", path.display())))?)
    } else {
        let beside = library.parent().into_iter().map(Path::to_owned);
        let mut folders = beside.chain(loader_folders());
        folders.find_map(|folder| ENGINE_FOLDERS.iter().find_map(|sub| at(&folder.join(sub).join(ENGINE))))
    };
    let name = found.clone().unwrap_or_else(|| PathBuf::from(ENGINE));
    // SAFETY: as for libk4a; libk4a is about to load the same.
    let engine = unsafe { Library::new(&name) }.map_err(|e| match &found {
        Some(path) => explain(format!("cannot be loaded from {}: {e}", path.display())),
        None => explain("was not found".to_owned()),
    })?;
    // SAFETY: the symbol is looked for and not called.
    let is_engine = unsafe { engine.get::<unsafe extern "C" fn()>(ENGINE_SYMBOL) }.is_ok();
    // It stays for the same reason as libk4a does.
    core::mem::forget(engine);
    if is_engine { Ok(found) } else { Err(explain(format!("is not what {} is", name.display()))) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_version_is_found_where_it_was_said() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("lib");
        std::fs::create_dir(&folder).unwrap();
        for name in ["libk4a.so.1.4", "libk4a.so.1.10.0", "libk4a.so.old", "libk4arecord.so.1.4"] {
            std::fs::write(folder.join(name), b"no library").unwrap();
        }
        let given = Places { library: Some(folder.clone()), engine: None };
        assert_eq!(find_with(&given, None, &[]).unwrap(), folder.join("libk4a.so.1.10.0"));
        let file = Places { library: Some(folder.join("libk4a.so.1.4")), engine: None };
        assert_eq!(find_with(&file, None, &[]).unwrap(), folder.join("libk4a.so.1.4"));
        let by_variable = find_with(&Places::default(), Some(folder.clone().into()), &[]);
        assert_eq!(by_variable.unwrap(), folder.join("libk4a.so.1.10.0"));
        let usual = find_with(&Places::default(), None, &[home.path().to_owned(), folder.clone()]);
        assert_eq!(usual.unwrap(), folder.join("libk4a.so.1.10.0"));
        let nowhere = find_with(&Places::default(), None, &[home.path().to_owned()]).unwrap_err();
        assert_eq!(nowhere.kind(), ErrorKind::BadInput);
        for part in ["libk4a1.4", "packages.microsoft.com", VARIABLE, "`library`"] {
            assert!(nowhere.to_string().contains(part), "{nowhere}");
        }
        let wrong =
            find_with(&Places::default(), Some("/no/such/place".into()), std::slice::from_ref(&folder));
        assert!(wrong.unwrap_err().to_string().contains("/no/such/place"), "a wrong place is an error");
    }

    #[test]
    fn what_is_no_library_is_said() {
        let home = tempfile::tempdir().unwrap();
        let file = home.path().join("libk4a.so.1.4");
        std::fs::write(&file, b"no library at all").unwrap();
        let e = load(&Places { library: Some(file.clone()), engine: None }).unwrap_err();
        assert!(e.to_string().contains("cannot be loaded") && e.kind() == ErrorKind::BadInput, "{e}");
        let places = Places { library: None, engine: Some(home.path().into()) };
        let e = load_engine(&places, &file).unwrap_err();
        assert!(e.to_string().contains("is not at") && e.to_string().contains("colour alone"), "{e}");
    }
}
