//! Models that come, go, are replaced while in use, and are killed half-way.

use super::*;
use crate::weights::write_seeded;
use std::sync::OnceLock;

/// A seeded model; made once for all tests.
fn seeded() -> &'static Path {
    static FILE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let made = || {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("seeded.safetensors");
        write_seeded(Encoder::Vits, 1, &path).unwrap();
        (dir, path)
    };
    &FILE.get_or_init(made).1
}

fn quiet(_: &'static str, _: u64, _: u64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn install(store: &ModelStore, import: Import) -> Result<Installed> {
    store.import(&Weights::open(seeded()).unwrap(), import, &mut quiet)
}

fn from_file(name: &str) -> Import {
    Import::new(name, Source::File { path: "/made/up".into(), sha256: "00".into(), bytes: 1 })
}

#[test]
fn a_model_is_installed_listed_used_and_removed() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(&dir.path().join("models"))).unwrap();
    assert!(store.list().unwrap().is_empty(), "a folder that is not there has no models");
    let mut import = from_file("demo");
    (import.input_size, import.channel_order, import.cameras) = (252, ChannelOrder::Rgb, vec!["D435".into()]);
    let installed = install(&store, import).unwrap();
    assert_eq!(store.info("demo").unwrap(), installed, "what is written is what is read");
    let record = &installed.record;
    assert!(!record.trained && record.encoder == Encoder::Vits && record.weights.tensors == 430);
    assert!(record.installed.ends_with('Z') && record.installed.starts_with("20"), "{}", record.installed);
    let model = store.model("demo").unwrap();
    assert_eq!((model.input_size, model.channel_order, model.max_depth_m), (252, ChannelOrder::Rgb, 6.0));
    assert!(model.id.starts_with("untrained-demo@") && !model.is_trained() && model.id == installed.id());
    assert!(model.id.ends_with(&record.weights.sha256[..8]));
    assert!(store.check("demo").unwrap().is_good());
    // The file's metadata and numbers are kept.
    let original = Weights::open(seeded()).unwrap();
    assert_eq!(model.weights.metadata(), original.metadata());
    for name in ["pretrained.pos_embed", "crossAtts.3.out_proj.bias"] {
        assert_eq!(model.weights.read(name).unwrap(), original.read(name).unwrap());
    }
    // Removed while in use: whoever has it keeps it.
    store.remove("demo").unwrap();
    assert!(store.list().unwrap().is_empty());
    let [kept, was] = [&model.weights, &original].map(|w| w.read("pretrained.pos_embed").unwrap());
    assert_eq!(kept, was);
    let e = store.model("demo").unwrap_err();
    assert!(e.kind() == ErrorKind::NotFound && e.to_string().contains("no model demo is installed"), "{e}");
    assert!(e.to_string().contains("(none is)") && e.to_string().contains("cdm import"), "{e}");
    let e = store.remove("cdm-d435").unwrap_err();
    assert!(e.to_string().contains("`depthrig cdm fetch cdm-d435` fetches it"), "{e}");
}

#[test]
fn a_file_serves_without_being_installed() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    let model = store.model(&seeded().display().to_string()).unwrap();
    assert!(model.id.starts_with("untrained-seeded@") && model.input_size == 518, "{}", model.id);
    let e = store.model("nothing.pth").unwrap_err();
    assert!(e.kind() == ErrorKind::NotFound && e.to_string().starts_with("nothing.pth: there is no"), "{e}");
}

#[test]
fn a_name_is_taken_once_and_replaced_in_one_step() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    install(&store, from_file("a")).unwrap();
    let old = store.get("a").unwrap();
    let e = install(&store, from_file("a")).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("installed already"), "{e}");
    let again = Import { replace: true, input_size: 308, ..from_file("a") };
    install(&store, again).unwrap();
    assert_eq!((store.get("a").unwrap().input_size, old.input_size), (308, 518));
    assert!(old.weights.read("pretrained.cls_token").is_ok_and(|b| b.len() == 4 * 384));
    let left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 2, "{left:?}: the model and the lock");
}

#[test]
fn what_is_not_finished_does_not_count_and_is_swept_up() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    // As a killed import and a killed removal leave them.
    for name in [".import-a", ".removed-b"] {
        std::fs::create_dir(dir.path().join(name)).unwrap();
        std::fs::write(dir.path().join(name).join(WEIGHTS), b"half").unwrap();
    }
    assert!(store.list().unwrap().is_empty());
    install(&store, from_file("a")).unwrap();
    assert_eq!(store.list().unwrap().len(), 1);
    assert!(!dir.path().join(".removed-b").exists() && !dir.path().join(".import-a").exists());
    // Ended by whoever watches.
    let mut calls = 0;
    let mut stop = |what: &'static str, _: u64, _: u64| {
        calls += u32::from(what == "install");
        if calls > 20 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let e = store.import(&Weights::open(seeded()).unwrap(), from_file("b"), &mut stop).unwrap_err();
    assert!(e.to_string().contains("nothing was installed") && calls == 21, "{e}");
    assert_eq!(store.list().unwrap().len(), 1);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
}

#[test]
fn two_do_not_change_the_folder_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    let _lock = store.lock().unwrap();
    let e = install(&store, from_file("a")).unwrap_err();
    assert!(e.to_string().contains("another `depthrig cdm` is changing"), "{e}");
}

#[test]
fn a_model_that_was_damaged_is_found_out() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    install(&store, from_file("a")).unwrap();
    let file = dir.path().join("a").join(WEIGHTS);
    let whole = std::fs::read(&file).unwrap();
    let mut bytes = whole.clone();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(&file, &bytes).unwrap();
    assert!(store.get("a").is_ok(), "every byte is looked at only when asked for");
    let e = store.check("a").unwrap_err();
    assert!(e.kind() == ErrorKind::BadModel && e.to_string().contains("SHA-256"), "{e}");
    std::fs::write(&file, &bytes[..last]).unwrap();
    let e = store.get("a").unwrap_err();
    assert!(e.kind() == ErrorKind::BadModel && e.to_string().contains("cut short"), "{e}");
    std::fs::write(dir.path().join("a").join(RECORD), "format = 2").unwrap();
    assert!(store.list().unwrap()[0].1.is_err());
    assert!(store.info("a").unwrap_err().to_string().contains("install the model a anew"));
}

#[test]
fn extra_tensors_are_an_error_or_are_written_down() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    let with_more = dir.path().join("more.safetensors");
    let original = Weights::open(seeded()).unwrap();
    durable::create(&with_more, |out| {
        let mut planned: Vec<_> = original
            .entries()
            .iter()
            .map(|(name, e)| weights::Planned { name: name.clone(), dtype: e.dtype, shape: e.shape.clone() })
            .collect();
        let extra =
            |name: &str| weights::Planned { name: name.into(), dtype: weights::Dtype::F32, shape: vec![1] };
        planned.push(extra("depth_head.extra"));
        weights::write(out, &mut planned, original.metadata(), &mut |t, out| {
            out.write_all(&original.read(&t.name).unwrap_or_else(|_| vec![0; 4]))
        })
    })
    .unwrap();
    let more = Weights::open(&with_more).unwrap();
    let e = store.import(&more, from_file("a"), &mut quiet).unwrap_err();
    assert!(e.to_string().contains("1 not of the network (depth_head.extra"), "{e}");
    assert!(e.to_string().contains("--drop-extra` installs the model without it"), "{e}");
    let import = Import { drop_extra: true, ..from_file("a") };
    let installed = store.import(&more, import, &mut quiet).unwrap();
    assert_eq!(installed.record.left_out, ["depth_head.extra"]);
    assert!(store.check("a").unwrap().is_good());
}

#[test]
fn a_camera_gets_the_published_model_else_one_that_names_it() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    assert_eq!(store.for_camera("ZED 2i").unwrap(), None);
    install(&store, Import { cameras: vec!["ZED 2i".into(), "webcam".into()], ..from_file("mine") }).unwrap();
    assert_eq!(store.for_camera("ZED 2i").unwrap().as_deref(), Some("mine"));
    assert_eq!(store.for_camera("Some Webcam 3").unwrap().as_deref(), Some("mine"));
    assert_eq!(install(&store, from_file("cdm-zed2i-quality")).unwrap().record.cameras, ["ZED 2i"]);
    assert_eq!(store.for_camera("ZED 2i").unwrap().as_deref(), Some("cdm-zed2i-quality"));
}

#[test]
fn bad_names_and_settings_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let store = ModelStore::open(Some(dir.path())).unwrap();
    for name in ["", ".hidden", "a/b", "../a", "a b", &"x".repeat(23)] {
        assert_eq!(install(&store, from_file(name)).unwrap_err().kind(), ErrorKind::BadInput, "{name}");
        assert!(store.remove(name).is_err() && store.info(name).is_err());
    }
    for import in [
        Import { input_size: 0, ..from_file("a") },
        Import { max_depth_m: f64::NAN, ..from_file("a") },
        Import { max_depth_m: 0.0, ..from_file("a") },
    ] {
        assert_eq!(install(&store, import).unwrap_err().kind(), ErrorKind::BadInput);
    }
    let vitl = Import { encoder: Some(Encoder::Vitl), ..from_file("a") };
    assert!(install(&store, vitl).unwrap_err().to_string().contains("vitl was asked for"));
    assert!(store.list().unwrap().is_empty());
}

/// A mapped file that becomes shorter ends the process with SIGBUS where it is read.
#[test]
fn a_checkpoint_that_becomes_shorter_while_it_is_imported_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("shrinking.safetensors");
    let store = ModelStore::open(Some(&dir.path().join("models"))).unwrap();
    for step in ["check", "install"] {
        std::fs::copy(seeded(), &path).unwrap();
        let weights = Weights::open(&path).unwrap();
        let half = weights.file_bytes() / 2;
        let mut shrink = |what: &'static str, _: u64, _: u64| {
            if what == step {
                File::options().write(true).open(&path).unwrap().set_len(half).unwrap();
            }
            ControlFlow::Continue(())
        };
        let e = store.import(&weights, from_file("short"), &mut shrink).unwrap_err();
        assert!(e.kind() == ErrorKind::Io && e.to_string().contains("became shorter"), "{step}: {e}");
        assert!(weights.sha256().unwrap_err().to_string().contains("became shorter"));
        assert!(store.list().unwrap().is_empty(), "{step}: nothing is installed");
    }
}

/// As `torch.save` writes them; engines read 32-bit floats in the order of their shape, where they lie.
#[test]
fn a_copy_has_every_tensor_in_order_and_in_32_bits_at_most() {
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/torch");
    let dir = tempfile::tempdir().unwrap();
    for name in ["halves.pth", "not_contiguous.pth"] {
        let original = Weights::open(fixtures.join(name)).unwrap();
        let path = dir.path().join(name);
        durable::create(&path, |out| {
            weights::copy(out, &original, |_| true, original.metadata(), &mut |_| true)
        })
        .unwrap();
        let copy = Weights::open(&path).unwrap();
        for (tensor, entry) in copy.entries() {
            assert!(entry.strides.is_none() && entry.dtype.bytes() <= 4, "{name}: {tensor}");
            assert_eq!(copy.to_f32(tensor).unwrap(), original.to_f32(tensor).unwrap(), "{name}: {tensor}");
        }
        assert_eq!(copy.entries().len(), original.entries().len());
    }
}
