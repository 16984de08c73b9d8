//! NVIDIA's libraries: loaded from pip's wheels beside ONNX Runtime's, and named with their cure where one is missing.
//!
//! ONNX Runtime's providers for CUDA and TensorRT are linked to libraries that their wheel does not hold. Pip installs these as
//! `nvidia/*/lib` and `tensorrt_libs` beside `onnxruntime`, where the system's loader does not look. A library that is loaded
//! already is found by its name, so each is loaded before the provider is.
// Loading a library is a call into foreign code.
#![allow(unsafe_code)]

use super::library::cause;
use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_NOW};
use std::path::{Path, PathBuf};

/// A library: the beginning of its file's name, and the package on PyPI that has it for CUDA 13.
struct Needed {
    stem: &'static str,
    package: &'static str,
}

const fn needed(stem: &'static str, package: &'static str) -> Needed {
    Needed { stem, package }
}

/// The libraries that the providers are linked to, each after those that it needs itself.
const CUDA: [Needed; 9] = [
    needed("libcudart.so", "nvidia-cuda-runtime"),
    needed("libnvJitLink.so", "nvidia-nvjitlink"),
    needed("libcublasLt.so", "nvidia-cublas"),
    needed("libcublas.so", "nvidia-cublas"),
    needed("libnvrtc.so", "nvidia-cuda-nvrtc"),
    needed("libcurand.so", "nvidia-curand"),
    needed("libcufft.so", "nvidia-cufft"),
    // It loads its own parts from beside itself.
    needed("libcudnn.so", CUDNN),
    needed("libcudnn_graph.so", CUDNN),
];
/// Those that TensorRT needs besides.
const TENSORRT: [Needed; 3] = [
    needed("libnvinfer.so", NVINFER),
    needed("libnvinfer_plugin.so", NVINFER),
    needed("libnvonnxparser.so", NVINFER),
];
/// Later ones have `libnvinfer.so.11`, to which the pinned library is not linked.
const NVINFER: &str = "'tensorrt-cu13<11'";
const CUDNN: &str = "nvidia-cudnn-cu13";
/// The driver's own, which no package on PyPI has.
const DRIVER: [&str; 2] = ["libcuda.so", "libnvidia-ml.so"];

/// Loads NVIDIA's libraries from the wheels beside that of `library`, ONNX Runtime's own, and returns those that were loaded. What is not there, or
/// cannot be loaded, is left to the system's loader, whose error says more ([`missing`]).
pub(super) fn preload(library: &Path, with_tensorrt: bool) -> Vec<PathBuf> {
    let Some(packages) = packages_of(library) else { return Vec::new() };
    let folders = folders(&packages);
    let wanted = CUDA.iter().chain(TENSORRT.iter().filter(|_| with_tensorrt));
    let found = wanted.filter_map(|needed| folders.iter().find_map(|folder| inside(folder, needed.stem)));
    found.filter(|path| load(path)).collect()
}

/// The folder of packages that holds the wheel of `library`.
fn packages_of(library: &Path) -> Option<PathBuf> {
    let library = library.canonicalize().ok()?;
    let capi = library.parent().filter(|p| p.ends_with("onnxruntime/capi"))?;
    capi.ancestors().nth(2).map(Path::to_path_buf)
}

/// The folders of NVIDIA's libraries there, in order of their names.
fn folders(packages: &Path) -> Vec<PathBuf> {
    let parts = std::fs::read_dir(packages.join("nvidia")).into_iter().flatten().flatten();
    let mut folders: Vec<PathBuf> = parts.map(|part| part.path().join("lib")).collect();
    folders.sort();
    folders.push(packages.join("tensorrt_libs"));
    folders.retain(|folder| folder.is_dir());
    folders
}

/// The library of this name there, of the highest version.
fn inside(folder: &Path, stem: &str) -> Option<PathBuf> {
    let version = |name: &str| -> Option<Vec<u32>> {
        name.strip_prefix(stem)?.split('.').skip(1).map(|n| n.parse().ok()).collect()
    };
    let entries = std::fs::read_dir(folder).ok()?.flatten();
    let libraries = entries.filter_map(|e| Some((version(e.file_name().to_str()?)?, e.path())));
    libraries.max().map(|(_, path)| path)
}

fn load(path: &Path) -> bool {
    // SAFETY: a library of the environment that ONNX Runtime was installed into; its initialisers run, as they would if that
    // were linked to it by path.
    match unsafe { Library::open(Some(path), RTLD_NOW | RTLD_GLOBAL) } {
        Ok(library) => {
            tracing::debug!(library = %path.display(), "loaded");
            // For as long as the process lives: the provider is linked to it.
            core::mem::forget(library);
            true
        }
        Err(e) => {
            tracing::debug!(library = %path.display(), "not loaded: {}", cause(&e));
            false
        }
    }
}

/// The library that an error of the system's loader names as missing, and what to do.
pub(super) fn missing(text: &str) -> Option<(String, String)> {
    const NOT_THERE: &str = ": cannot open shared object file";
    let name = text[..text.find(NOT_THERE)?].rsplit([' ', ':', '\n', '"']).next()?;
    let name = name.rsplit('/').next()?;
    let of =
        |stem: &&str| name.strip_prefix(*stem).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
    let cure = if DRIVER.iter().any(of) {
        "it is part of NVIDIA's driver: install that, and see that `nvidia-smi` lists the GPU".to_owned()
    } else {
        let known = CUDA.iter().chain(&TENSORRT).find(|n| of(&n.stem));
        let package = match known {
            Some(known) => known.package,
            None if name.starts_with("libcudnn") => CUDNN,
            None if name.starts_with("libnvinfer") => NVINFER,
            None => return Some((name.to_owned(), GENERAL.to_owned())),
        };
        format!(
            "`pip install {package}` into the environment of onnxruntime-gpu (wheels beside it are loaded), or install it for the \
             whole system; the version must be that of its name"
        )
    };
    Some((name.to_owned(), cure))
}

const GENERAL: &str =
    "install the package that has it; CUDA 13, cuDNN 9 and for TensorRT nvinfer 10 are needed";

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    /// A library made from C, of this soname, linked to others beside it.
    fn library(folder: &Path, soname: &str, linked: &[&str], source: &str) -> PathBuf {
        std::fs::create_dir_all(folder).unwrap();
        let c = folder.join("source.c");
        std::fs::write(&c, source).unwrap();
        let path = folder.join(soname);
        let mut cc = Command::new("cc");
        cc.args(["-shared", "-fPIC", "-o"]).arg(&path).arg(&c).arg(format!("-Wl,-soname,{soname}"));
        cc.args(linked.iter().map(ToString::to_string));
        assert!(cc.status().unwrap().success());
        std::fs::remove_file(c).unwrap();
        path
    }

    #[test]
    fn libraries_of_wheels_beside_are_loaded_before_what_is_linked_to_them() {
        let environment = tempfile::tempdir().unwrap();
        let packages = environment.path().canonicalize().unwrap().join("lib/python3.11/site-packages");
        let runtime =
            library(&packages.join("onnxruntime/capi"), "libonnxruntime.so.1.31.1", &[], "int ort;");
        let lt = library(
            &packages.join("nvidia/cu13/lib"),
            "libcublasLt.so.13",
            &[],
            "int made_lt(void) { return 13; }",
        );
        let blas = library(
            &packages.join("nvidia/cu13/lib"),
            "libcublas.so.13",
            &[lt.to_str().unwrap()],
            "int made_lt(void); int made_blas(void) { return 1 + made_lt(); }",
        );
        library(&packages.join("nvidia/cu13/lib"), "libcublas.so.12", &[], "int old;");
        let infer = library(&packages.join("tensorrt_libs"), "libnvinfer.so.10", &[], "int infer;");
        std::fs::create_dir_all(packages.join("nvidia/cudnn/lib")).unwrap();
        std::fs::write(packages.join("nvidia/cudnn/lib/libcudnn.so.9"), "damaged").unwrap();
        // As ONNX Runtime's provider is: linked to both by name alone.
        let provider = library(
            &packages.join("onnxruntime/capi"),
            "libprovider.so",
            &[blas.to_str().unwrap(), infer.to_str().unwrap()],
            "int made_blas(void); int made(void) { return 1 + made_blas(); }",
        );
        // SAFETY: a library of this test.
        let early = unsafe { libloading::Library::new(&provider) }.expect_err("nothing is loaded yet");
        let (name, cure) = missing(&cause(&early)).expect("the loader names what is missing");
        assert_eq!(name, "libcublas.so.13", "{early}");
        assert!(cure.contains("pip install nvidia-cublas"), "{cure}");

        assert_eq!(preload(&runtime, false), [lt.clone(), blas.clone()]);
        assert_eq!(preload(&runtime, true), [lt, blas, infer]);
        // SAFETY: a library of this test.
        let provider = unsafe { libloading::Library::new(&provider) }.expect("what it needs is loaded");
        // SAFETY: a function of the source above.
        let made = unsafe { provider.get::<unsafe extern "C" fn() -> i32>(b"made\0").unwrap()() };
        assert_eq!(made, 15);
    }

    #[test]
    fn without_wheels_beside_nothing_is_loaded() {
        let folder = tempfile::tempdir().unwrap();
        let library = folder.path().join("libonnxruntime.so");
        std::fs::write(&library, "").unwrap();
        assert!(preload(&library, true).is_empty());
        assert!(preload(Path::new("/none/onnxruntime/capi/libonnxruntime.so"), true).is_empty());
    }

    #[test]
    fn errors_of_the_loader_name_the_library_and_its_package() {
        for (library, package) in [
            ("libcublasLt.so.13", "nvidia-cublas"),
            ("libcudart.so.13", "nvidia-cuda-runtime"),
            ("libcudnn.so.9", "nvidia-cudnn-cu13"),
            ("libcudnn_ops.so.9", "nvidia-cudnn-cu13"),
            ("libcufft.so.12", "nvidia-cufft"),
            ("libcurand.so.10", "nvidia-curand"),
            ("libnvinfer.so.10", "'tensorrt-cu13<11'"),
            ("libnvonnxparser.so.10", "'tensorrt-cu13<11'"),
        ] {
            // As version 1.31.1 says it on a computer without CUDA.
            let text = format!(
                "/onnxruntime_src/onnxruntime/core/session/provider_bridge_ort.cc:2043 onnxruntime::Provider& \
                 onnxruntime::ProviderLibrary::Get() [ONNXRuntimeError] : 1 : FAIL : Failed to load library \
                 /e/onnxruntime/capi/libonnxruntime_providers_cuda.so with error: {library}: cannot open shared object file: \
                 No such file or directory"
            );
            let (name, cure) = missing(&text).unwrap();
            assert_eq!(name, library);
            assert!(cure.contains(&format!("`pip install {package}`")), "{cure}");
        }
        let (name, cure) = missing("libcuda.so.1: cannot open shared object file: No such file").unwrap();
        assert!(name == "libcuda.so.1" && cure.contains("driver") && !cure.contains("pip"), "{cure}");
        let (name, cure) = missing("libmine.so.3: cannot open shared object file: No such file").unwrap();
        assert!(name == "libmine.so.3" && cure.contains("CUDA 13"), "{cure}");
        assert_eq!(missing("CUDA failure 100: no CUDA-capable device is detected"), None);
    }
}
