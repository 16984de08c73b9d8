//! Keeps outputs out of inputs: an export must not change the dataset that it reads.

use crate::{Error, ErrorKind, Result, SESSION_FILE};
use std::path::{Path, PathBuf};

/// Refuses an output `out` that is the input `input` or lies in its folder, by any path or link. The input may be a
/// dataset, one of its segments, or a folder of images.
///
/// # Errors
/// [`ErrorKind::BadInput`].
pub fn check_outside(out: &Path, input: &Path) -> Result<()> {
    let Ok(real) = std::fs::canonicalize(input) else { return Ok(()) };
    let segment_of = || real.parent().filter(|dir| dir.join(SESSION_FILE).exists());
    let read = if real.is_dir() { Some(real.as_path()) } else { segment_of() };
    let Some((read, written)) = read.zip(resolved(out)) else { return Ok(()) };
    if !written.starts_with(read) {
        return Ok(());
    }
    let what = format!(
        "{} lies in {}, which is read and must stay as it is; choose a folder outside of it",
        out.display(),
        input.display()
    );
    Err(Error::new(ErrorKind::BadInput, what))
}

/// The path with the links of its folders followed, as far as it is there.
fn resolved(path: &Path) -> Option<PathBuf> {
    let path = std::path::absolute(path).ok()?;
    path.ancestors().find_map(|there| {
        let rest = path.strip_prefix(there).ok()?;
        Some(std::fs::canonicalize(there).ok()?.join(rest))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_in_the_input_is_refused_by_whatever_path() {
        let dir = tempfile::tempdir().unwrap();
        let dataset = dir.path().join("ds");
        std::fs::create_dir_all(dataset.join("sub")).unwrap();
        std::fs::write(dataset.join(SESSION_FILE), "").unwrap();
        std::fs::write(dataset.join("seg_0000.mcap"), "").unwrap();
        std::os::unix::fs::symlink(&dataset, dir.path().join("link")).unwrap();
        let segment = dataset.join("seg_0000.mcap");
        for input in [&dataset, &dir.path().join("link"), &segment] {
            for out in ["ds", "ds/inner", "ds/sub/a/b", "link/inner", "ds/../ds/x", "link"] {
                let e = check_outside(&dir.path().join(out), input).expect_err(out);
                assert_eq!(e.kind(), ErrorKind::BadInput, "{out}");
            }
            for out in ["ds2", "ds_inner/x", "other", "link2"] {
                check_outside(&dir.path().join(out), input).expect(out);
            }
        }
        check_outside(Path::new("/nowhere/x"), Path::new("/nowhere")).expect("nothing is read there");
    }
}
