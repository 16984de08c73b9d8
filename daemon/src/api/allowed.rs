//! Where a recording that is asked for over the API may go.

use crate::{Error, ErrorKind, Result};
use std::path::{Component, Path, PathBuf};

/// The folder `asked` without links and `..`, which must lie in or below one of `roots`. A rig without any is one that
/// leaves the choice to its user.
pub(super) fn below(asked: &Path, roots: &[PathBuf]) -> Result<PathBuf> {
    if roots.is_empty() {
        return Ok(asked.to_owned());
    }
    let listed = || roots.iter().map(|r| r.display().to_string()).collect::<Vec<_>>().join(", ");
    let refused = |why: &str| {
        let message = format!(
            "invalid directory {}: {why}; recordings of this rig go below {}, other folders can be added with \
             recording.allow in the rig's file",
            asked.display(),
            listed()
        );
        Error::new(ErrorKind::PermissionDenied, message)
    };
    if !asked.is_absolute() {
        return Err(refused("it is not an absolute path"));
    }
    let resolved =
        resolve(asked).ok_or_else(|| refused("it has \"..\" below a folder that does not exist"))?;
    let is_below = |root: &PathBuf| resolve(root).is_some_and(|root| resolved.starts_with(root));
    if roots.iter().any(is_below) { Ok(resolved) } else { Err(refused("it is elsewhere")) }
}

/// The path with the links of its existing part resolved; `None` when what does not exist yet has `..` in it.
fn resolve(path: &Path) -> Option<PathBuf> {
    let path = std::path::absolute(path).ok()?;
    let (existing, real) = path.ancestors().find_map(|a| a.canonicalize().ok().map(|real| (a, real)))?;
    let rest = path.strip_prefix(existing).ok()?;
    let plain = rest.components().all(|c| matches!(c, Component::Normal(_)));
    plain.then(|| if rest.as_os_str().is_empty() { real.clone() } else { real.join(rest) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_really_below_is_allowed() {
        let home = tempfile::tempdir().unwrap();
        let home = home.path().canonicalize().unwrap();
        let data = home.join("data");
        let outside = home.join("outside");
        std::fs::create_dir_all(data.join("deep")).unwrap();
        std::fs::create_dir_all(&outside).unwrap();
        std::os::unix::fs::symlink(&outside, data.join("link")).unwrap();
        std::os::unix::fs::symlink(&data, home.join("way_in")).unwrap();
        let roots = [data.clone(), home.join("not_made_yet")];
        let ask = |path: &Path| below(path, &roots);
        for good in ["data", "data/deep", "data/deep/..", "data/new/er", "way_in/x", "not_made_yet/x"] {
            assert!(ask(&home.join(good)).is_ok(), "{good}: {:?}", ask(&home.join(good)));
        }
        assert_eq!(ask(&home.join("way_in/x")).unwrap(), data.join("x"), "links are followed once, here");
        for bad in [
            "outside",
            "data/../outside",
            "data/link",
            "data/link/x",
            "data/new/../../outside",
            "",
            "..",
            "database",
            "data/new/..",
        ] {
            let e = ask(&home.join(bad)).unwrap_err();
            assert_eq!(e.kind(), ErrorKind::PermissionDenied, "{bad}");
            assert!(e.to_string().contains("recording.allow"), "{e}");
        }
        assert!(ask(Path::new("data")).is_err(), "relative to whom?");
        assert!(below(&outside, &[]).is_ok());
    }
}
