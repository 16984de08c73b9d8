//! The live page: where it is, and its files, which are part of the binary.

use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::MethodRouter;
use flate2::Compression;
use flate2::write::GzEncoder;
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Nothing from elsewhere, no script or style in the markup, no markup from text.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; base-uri 'none'; \
     form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'";

/// A file of the page.
pub(super) struct File {
    name: &'static str,
    bytes: &'static [u8],
    /// The same in gzip's form, a quarter of it, made when it is first asked for.
    packed: OnceLock<Vec<u8>>,
}

macro_rules! files {
    ($($name:literal)*) => {
        [$(File {
            name: $name,
            bytes: include_bytes!(concat!("../../page/", $name)),
            packed: OnceLock::new(),
        }),*]
    };
}

/// The files in the folder `page`.
pub(super) static FILES: [File; 89] = files![
    "advice.js" "aids.js" "aidsdepth.js" "aidsimage.js" "aidsoverlay.js" "api.js" "boardoverlay.js"
    "calibrationpanel.js" "calibrationtext.js" "cloudbar.js" "cloudgl.js" "cloudhints.js"
    "cloudinput.js" "cloudlabels.js" "cloudscene.js" "cloudshaders.js" "cloudsource.js"
    "cloudview.js" "colormap.js" "connection.js" "controlrow.js" "controlspanel.js" "controltext.js"
    "countdown.js" "dataset.js" "depthstats.js" "doctorpanel.js" "dom.js" "doublepress.js"
    "episodebar.js" "episodespanel.js" "episodetext.js" "eventstream.js" "fit.js" "hover.js" "icon.svg" "imagestats.js" "index.html" "keys.js"
    "labels.js" "layout.js" "lens.js" "livestatus.js" "lossstrip.js" "losstime.js" "main.js"
    "matrix.js" "mixture.js" "orbit.js" "painter.js" "panels.css" "panels.js" "paneltypes.js"
    "plane.js" "protocol.js" "range.js" "ready.js" "recordbar.js" "recording.js" "recordingrow.js"
    "recordings.js" "recordingtext.js" "recordtext.js" "reference.js" "referencetext.js"
    "replaybar.js" "savedialog.js" "scenes.js" "shift.js" "signals.js" "signalspanel.js" "skew.js" "slot.js" "sound.js" "style.css"
    "syncpanel.js" "takes.js" "thinning.js" "tile.js" "tilestate.js" "types.js" "uncertaintymap.js"
    "uncertaintytext.js" "usbtree.js" "view.css" "wall.js" "watch.js" "wipeline.js" "words.js"
];

/// Where reports are, each below an address of its own: a tab that is opened cannot send the token.
pub(super) const REPORT: &str = "/v1/report/";
/// The WebSocket of the live page.
pub(super) const LIVE: &str = "/v1/live";

/// Where the live page is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PageAddress {
    /// Its address without the token; `None` without a port.
    pub url: Option<String>,
    /// The file with the token, which the user that runs the rig can read.
    pub token_file: Option<PathBuf>,
    /// Where viewers with Foxglove's protocol find the rig, without the token that follows; `None` where that is off.
    #[serde(default)]
    pub foxglove: Option<String>,
}

impl PageAddress {
    pub(super) fn of(tcp: Option<SocketAddr>, foxglove: Option<SocketAddr>, token: Option<&Path>) -> Self {
        let url = |scheme: &str, tcp: SocketAddr| {
            // A page of another name has another origin, and another place for its token.
            if tcp.ip() == IpAddr::V4(Ipv4Addr::LOCALHOST) {
                format!("{scheme}://localhost:{}/", tcp.port())
            } else {
                format!("{scheme}://{tcp}/")
            }
        };
        Self {
            url: tcp.map(|tcp| url("http", tcp)),
            token_file: token.map(Path::to_owned),
            foxglove: foxglove.map(|tcp| url("ws", tcp)),
        }
    }
}

/// Whether a port serves this path without a token: the page has no secret.
pub(super) fn is_page(path: &str) -> bool {
    FILES.iter().any(|f| f.path() == path)
}

impl File {
    /// Where it is served.
    pub(super) fn path(&self) -> String {
        if self.name == "index.html" { "/".to_owned() } else { format!("/{}", self.name) }
    }

    fn content_type(&self) -> &'static str {
        match self.name.rsplit_once('.') {
            Some((_, "html")) => "text/html; charset=utf-8",
            Some((_, "css")) => "text/css; charset=utf-8",
            Some((_, "js")) => "text/javascript; charset=utf-8",
            Some((_, "svg")) => "image/svg+xml",
            _ => "application/octet-stream",
        }
    }

    /// Serves it.
    pub(super) fn handler<S: Clone + Send + Sync + 'static>(&'static self) -> MethodRouter<S> {
        axum::routing::get(async move |headers: axum::http::HeaderMap| {
            let takes_gzip = |v: &HeaderValue| v.to_str().is_ok_and(|v| v.contains("gzip"));
            let is_packed = headers.get(header::ACCEPT_ENCODING).is_some_and(takes_gzip);
            self.answer(headers.get(header::IF_NONE_MATCH), is_packed)
        })
    }

    /// The file in gzip's form.
    fn packed(&self) -> &[u8] {
        self.packed.get_or_init(|| {
            let mut packer = GzEncoder::new(Vec::new(), Compression::best());
            // Writing into memory does not fail; an empty answer would show in every test.
            packer.write_all(self.bytes).and_then(|()| packer.finish()).unwrap_or_default()
        })
    }

    fn answer(&'static self, known: Option<&HeaderValue>, is_packed: bool) -> Response {
        let tag = format!("\"{:08x}\"", crc32fast::hash(self.bytes));
        let same = known.is_some_and(|k| k.as_bytes() == tag.as_bytes());
        let fixed: [(HeaderName, &'static str); 6] = [
            (header::VARY, "Accept-Encoding"),
            (header::CONTENT_TYPE, self.content_type()),
            (header::CONTENT_SECURITY_POLICY, POLICY),
            (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (header::REFERRER_POLICY, "no-referrer"),
            (header::CACHE_CONTROL, "no-cache"),
        ];
        let tag = [(header::ETAG, tag)];
        if same {
            return (StatusCode::NOT_MODIFIED, fixed, tag).into_response();
        }
        if is_packed {
            return (fixed, tag, [(header::CONTENT_ENCODING, "gzip")], self.packed()).into_response();
        }
        (fixed, tag, self.bytes).into_response()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_the_folder() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/page");
        let mut on_disk: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        on_disk.sort();
        assert_eq!(on_disk, FILES.iter().map(|f| f.name).collect::<Vec<_>>(), "in the order of their names");
        for file in &FILES {
            assert_ne!(file.content_type(), "application/octet-stream", "{}", file.name);
        }
        let bytes: usize = FILES.iter().map(|f| f.bytes.len()).sum();
        // Less of it is loaded when the page is opened: tests/python/test_page.py.
        assert!(bytes < 420 << 10, "the page has {bytes} bytes");
    }

    #[test]
    fn a_known_file_is_not_sent_again() {
        let file = FILES.iter().find(|f| f.path() == "/").unwrap();
        let first = file.answer(None, false);
        assert_eq!(first.status(), StatusCode::OK);
        let tag = first.headers()[header::ETAG].clone();
        assert_eq!(file.answer(Some(&tag), true).status(), StatusCode::NOT_MODIFIED);
        assert!(first.headers().contains_key(header::CONTENT_SECURITY_POLICY));
    }
}
