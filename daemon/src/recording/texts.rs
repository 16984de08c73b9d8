//! Texts of a request that would make a dataset which nothing reads.

use crate::control::RecordRequest;
use crate::{Error, ErrorKind, Result};
use depthrig_recorder::NOTE_MAX_BYTES;

/// Refuses texts that no dataset takes, before there is one.
///
/// # Errors
/// `BadInput` that names the text.
pub(super) fn check(request: &RecordRequest) -> Result<()> {
    let texts = [("scene", &request.scene), ("operator", &request.operator), ("notes", &request.notes)];
    if let Some((name, text)) = texts.into_iter().find(|(_, text)| text.len() > NOTE_MAX_BYTES) {
        let message = format!("invalid {name}: it has {} bytes, {NOTE_MAX_BYTES} is the limit", text.len());
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    let directory = request.directory.as_ref().map(|d| d.to_string_lossy());
    if let Some(directory) = directory.filter(|d| d.contains(char::is_control)) {
        let message =
            format!("invalid directory \"{}\": it has control characters", directory.escape_debug());
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_that_no_dataset_takes_is_refused_by_name() {
        let limit = "x".repeat(NOTE_MAX_BYTES);
        let long = limit.clone() + "x";
        let all = |text: &str| RecordRequest {
            scene: text.to_owned(),
            operator: text.to_owned(),
            notes: text.to_owned(),
            ..RecordRequest::default()
        };
        check(&all(&limit)).unwrap();
        for (name, request) in [
            ("scene", RecordRequest { scene: long.clone(), ..all("") }),
            ("operator", RecordRequest { operator: long.clone(), ..all("") }),
            ("notes", RecordRequest { notes: long.clone(), ..all("") }),
            ("directory", RecordRequest { directory: Some("/data\n/x".into()), ..all("") }),
        ] {
            let e = check(&request).unwrap_err();
            assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains(name), "{name}: {e}");
        }
    }
}
