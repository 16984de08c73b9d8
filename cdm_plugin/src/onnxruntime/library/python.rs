//! The package `onnxruntime` of the Python environment in which the program is installed.
//!
//! The wheel of depthrig puts the program into `bin` of an environment; `pip install onnxruntime`, into the same one, puts
//! the library into `lib/python3.X/site-packages/onnxruntime/capi`.

use std::path::{Path, PathBuf};

/// Where the packages of a Python are, below its folder: pip's, and Debian's for the system's Python.
const PACKAGES: [&str; 2] = ["site-packages", "dist-packages"];

/// Folders of the package that exist in the environment of `program`, of the newest Python first; none if the program does
/// not lie in a folder `bin`.
pub(super) fn folders(program: &Path) -> Vec<PathBuf> {
    let Some(bin) = program.parent().filter(|p| p.ends_with("bin")) else { return Vec::new() };
    let Some(environment) = bin.parent() else { return Vec::new() };
    let mut found = Vec::new();
    for library in ["lib", "lib64"] {
        let Ok(entries) = std::fs::read_dir(environment.join(library)) else { continue };
        for entry in entries.flatten() {
            let Some(minor) = entry.file_name().to_str().and_then(minor_version) else { continue };
            for packages in PACKAGES {
                found.push((minor, entry.path().join(packages).join("onnxruntime/capi")));
            }
        }
    }
    found.retain(|(_, folder)| folder.is_dir());
    found.sort_by_key(|(minor, _)| std::cmp::Reverse(*minor));
    found.into_iter().map(|(_, folder)| folder).collect()
}

/// 11 for `python3.11`.
fn minor_version(name: &str) -> Option<u32> {
    name.strip_prefix("python3.")?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_package_of_the_programs_own_environment_is_found_newest_python_first() {
        let environment = tempfile::tempdir().unwrap();
        let add = |name: &str| {
            let folder = environment.path().join(name).join("onnxruntime/capi");
            std::fs::create_dir_all(&folder).unwrap();
            folder
        };
        let old = add("lib/python3.9/site-packages");
        let new = add("lib/python3.13/site-packages");
        let debian = add("lib/python3.11/dist-packages");
        add("lib/python2.7/site-packages");
        add("lib/node/site-packages");
        std::fs::create_dir_all(environment.path().join("lib/python3.14/site-packages")).unwrap();

        let program = environment.path().join("bin/depthrig");
        assert_eq!(folders(&program), [new, debian, old], "3.13 is newer than 3.9");
        let elsewhere = environment.path().join("tools/depthrig");
        assert!(folders(&elsewhere).is_empty(), "a program outside of bin belongs to no environment");
    }
}
