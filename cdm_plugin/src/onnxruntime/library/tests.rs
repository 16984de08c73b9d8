//! Libraries that are missing, damaged, foreign or of another version: one error each, and the process goes on.

use super::*;
use crate::Precision;
use std::process::Command;

fn device() -> Device {
    Device::Cpu
}

/// A library made from C.
fn library(dir: &Path, name: &str, source: &str) -> PathBuf {
    let c = dir.join(format!("{name}.c"));
    let so = dir.join(name);
    std::fs::write(&c, source).unwrap();
    let made = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&so).arg(&c).status().unwrap();
    assert!(made.success());
    so
}

fn of_version(dir: &Path, version: &str) -> PathBuf {
    let source = format!(
        "static const void *api(unsigned n) {{ (void)n; return 0; }}
         static const char *version(void) {{ return {version}; }}
         static const struct {{ const void *(*api)(unsigned); const char *(*version)(void); }} base = {{ api, version }};
         const void *OrtGetApiBase(void) {{ return &base; }}"
    );
    let name: String = version.chars().filter(char::is_ascii_alphanumeric).collect();
    library(dir, &format!("lib{name}.so"), &source)
}

#[test]
fn versions() {
    let dir = tempfile::tempdir().unwrap();
    for version_text in ["1.23.0", "1.31.1", "1.99.0-dev"] {
        let path = of_version(dir.path(), &format!("\"{version_text}\""));
        assert_eq!(version(&path).unwrap(), version_text);
    }
    for (text, says) in [
        ("\"1.22.9\"", "1.22.9, which is too old"),
        ("\"2.0.0\"", "\"2.0.0\""),
        ("\"nonsense\"", "nonsense"),
        ("\"\"", "\"\""),
        ("0", "does not report its version"),
    ] {
        let error = version(&of_version(dir.path(), text)).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::NoEngine, "{error}");
        let message = error.to_string();
        assert!(
            message.contains(says) && message.contains("1.23") && message.contains("pip install"),
            "{message}"
        );
    }
}

#[test]
fn what_is_no_onnx_runtime() {
    let dir = tempfile::tempdir().unwrap();
    let other = library(dir.path(), "libother.so", "int answer(void) { return 42; }");
    let none = library(dir.path(), "libnone.so", "const void *OrtGetApiBase(void) { return 0; }");
    let text = dir.path().join("text.so");
    std::fs::write(
        &text,
        "not a library at all; long enough for a header though, so that its mark is what counts",
    )
    .unwrap();
    let empty = dir.path().join("empty.so");
    std::fs::write(&empty, "").unwrap();
    for (path, says) in [
        (other.as_path(), "not ONNX Runtime"),
        (&none, "no interface"),
        (&text, "not a library of this kind of computer"),
        (&empty, "cut short"),
        (&dir.path().join("absent.so"), "cannot be read"),
    ] {
        let error = version(path).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::NoEngine);
        assert!(error.to_string().contains(says), "{error}");
        assert!(error.to_string().contains(&path.display().to_string()), "{error}");
    }
}

#[test]
fn a_library_that_lacks_another_says_which() {
    let dir = tempfile::tempdir().unwrap();
    let other = library(dir.path(), "libother.so.7", "int other(void) { return 7; }");
    let source = dir.path().join("needs.c");
    std::fs::write(&source, "int other(void); int needs(void) { return other(); }").unwrap();
    let needs = dir.path().join("libneeds.so");
    let mut cc = Command::new("cc");
    cc.args(["-shared", "-fPIC", "-L"])
        .arg(dir.path())
        .arg("-l:libother.so.7")
        .arg("-o")
        .arg(&needs)
        .arg(&source);
    assert!(cc.arg("-Wl,--no-as-needed").arg("-l:libother.so.7").status().unwrap().success());
    std::fs::remove_file(other).unwrap();
    let message = version(&needs).unwrap_err().to_string();
    assert!(message.contains("libother.so.7: cannot open shared object file"), "{message}");
}

/// The loader of the system would end the process with a bus error.
#[test]
fn a_library_that_is_cut_short() {
    let dir = tempfile::tempdir().unwrap();
    let good = of_version(dir.path(), "\"1.31.1\"");
    let bytes = std::fs::read(&good).unwrap();
    let cut = dir.path().join("cut.so");
    for keep in [63, 64, 200, 0x1000, 0x2100] {
        std::fs::write(&cut, &bytes[..keep]).unwrap();
        let error = version(&cut).unwrap_err();
        assert!(error.to_string().contains("cut short"), "{keep}: {error}");
    }
}

#[test]
fn where_it_is_looked_for() {
    let dir = tempfile::tempdir().unwrap();
    let touch = |name: &str| {
        let path = dir.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, "").unwrap();
        path
    };
    touch("capi/libonnxruntime.so.1.9.0");
    let newest = touch("capi/libonnxruntime.so.1.31.1");
    touch("capi/libonnxruntime_providers_shared.so");
    touch("capi/libonnxruntime.so.backup");
    let capi = dir.path().join("capi");
    assert_eq!(find(Some(&newest), None, &device()).unwrap(), newest, "a file is itself");
    assert_eq!(find(Some(&capi), None, &device()).unwrap(), newest, "of a folder, the highest version");
    assert_eq!(find(None, Some(capi.as_os_str()), &device()).unwrap(), newest, "the variable");
    let other = touch("other/libonnxruntime.so");
    let wanted = dir.path().join("other");
    assert_eq!(find(Some(&wanted), Some(capi.as_os_str()), &device()).unwrap(), other, "settings come first");

    let absent = dir.path().join("absent");
    for error in [
        find(Some(&absent), Some(capi.as_os_str()), &device()).unwrap_err(),
        find(None, Some(absent.as_os_str()), &device()).unwrap_err(),
    ] {
        assert_eq!(error.kind(), ErrorKind::NoEngine);
        let message = error.to_string();
        assert!(message.contains("absent") && message.contains("`pip install onnxruntime`"), "{message}");
    }
    let gpu: Device = "cuda:1".parse().unwrap();
    assert!(find(Some(&absent), None, &gpu).unwrap_err().to_string().contains("onnxruntime-gpu"));
    let first = |device: &Device| places(device)[0].clone();
    assert!(first(&device()).ends_with("onnxruntime/cpu") && first(&gpu).ends_with("onnxruntime/gpu"));
}

#[test]
fn devices_by_name_and_their_precisions() {
    for name in ["cpu", "cuda:0", "cuda:3", "tensorrt:0", "openvino", "openvino:GPU.1"] {
        assert_eq!(name.parse::<Device>().unwrap().to_string(), name);
    }
    assert_eq!("cuda".parse::<Device>().unwrap(), Device::Cuda(0));
    assert_eq!("openvino:gpu".parse::<Device>().unwrap(), Device::OpenVino("GPU".into()));
    for name in ["", "gpu", "cpu:0", "cuda:", "cuda:-1", "cuda:x", "openvino:", "openvino:GPU\"}", "CPU"] {
        let error = name.parse::<Device>().unwrap_err();
        assert_eq!(error.kind(), ErrorKind::BadInput, "{name}");
        assert!(error.to_string().contains(&format!("{name:?}")), "{error}");
    }
    for (name, precision, says) in [
        ("cpu", Precision::Fp16, "openvino"),
        ("cpu", Precision::Bf16, "openvino"),
        ("cuda:0", Precision::Bf16, "fp16"),
        ("openvino", Precision::Fp16, "bf16"),
    ] {
        let error = name.parse::<Device>().unwrap().check(precision).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Unsupported);
        assert!(error.to_string().contains(says), "{error}");
    }
    for name in ["cpu", "cuda", "tensorrt", "openvino", "openvino:GPU"] {
        name.parse::<Device>().unwrap().check(Precision::Fp32).unwrap();
    }
}
