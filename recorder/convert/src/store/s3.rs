//! A prefix of a bucket.

use super::http::Connector;
use core::time::Duration;
use depthrig_recorder::{Error, ErrorKind, Result};
use object_store::aws::{AmazonS3, AmazonS3Builder};
use object_store::path::Path as Key;
use object_store::{
    BackoffConfig, GetOptions, GetRange, MultipartUpload, ObjectStore, ObjectStoreExt as _, PutMode,
    PutOptions, PutPayload, RetryConfig,
};
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::sync::Arc;
use tokio::runtime::Runtime;

/// Bytes of one request: what a lost connection repeats.
const PART: u64 = 16 << 20;
/// How often a request is sent again before the server counts as away.
const RETRIES: usize = 5;
/// Wait before a write is tried again that was in the way of another one.
const CONFLICT_WAIT: Duration = Duration::from_millis(200);
/// The endpoint without `AWS_ENDPOINT_URL`, in messages.
const AWS: &str = "Amazon S3";

/// A prefix of a bucket of S3 or of a server that speaks like it.
#[derive(Debug, Clone)]
pub struct Remote {
    store: Arc<AmazonS3>,
    runtime: Arc<Runtime>,
    endpoint: Arc<str>,
    bucket: Arc<str>,
    prefix: String,
}

/// Names directly below a prefix.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Listing {
    /// Names of prefixes, rising.
    pub folders: Vec<String>,
    /// Objects with their bytes, by name.
    pub files: Vec<(String, u64)>,
}

impl core::fmt::Display for Remote {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}{}/{}", super::SCHEME, self.bucket, self.prefix)
    }
}

impl Remote {
    /// The prefix of a bucket, with the credentials, the region and the endpoint of the environment (`AWS_…`). No request is sent.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when the settings of the environment contradict each other.
    pub(super) fn open(bucket: &str, prefix: &str) -> Result<Self> {
        let set = |key: &str| std::env::var(key).ok().filter(|value| !value.is_empty());
        let endpoint = set("AWS_ENDPOINT_URL_S3").or_else(|| set("AWS_ENDPOINT_URL"));
        let url = endpoint.clone().unwrap_or_default();
        let backoff = BackoffConfig { max_backoff: Duration::from_secs(4), ..BackoffConfig::default() };
        let retry = RetryConfig { backoff, max_retries: RETRIES, retry_timeout: Duration::from_mins(2) };
        let bad = |e: object_store::Error| {
            let what = format!("{}{bucket} cannot be used: {e}; check the variables AWS_…", super::SCHEME);
            Error::new(ErrorKind::BadInput, what).with_source(e)
        };
        let store = AmazonS3Builder::from_env()
            .with_bucket_name(bucket)
            .with_allow_http(url.starts_with("http://"))
            .with_retry(retry)
            .with_http_connector(Connector { url })
            .build()
            .map_err(bad)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
        let runtime =
            runtime.map_err(|e| Error::new(ErrorKind::Io, format!("cannot start a runtime: {e}")))?;
        Ok(Self {
            store: Arc::new(store),
            runtime: Arc::new(runtime),
            endpoint: endpoint.as_deref().unwrap_or(AWS).into(),
            bucket: bucket.into(),
            prefix: prefix.trim_matches('/').to_owned(),
        })
    }

    /// The last part of the prefix; the bucket's name where that is empty.
    pub fn name(&self) -> &str {
        self.prefix.rsplit('/').next().filter(|name| !name.is_empty()).unwrap_or(&self.bucket)
    }

    /// The prefix `name` below this one.
    #[must_use]
    pub fn at(&self, name: &str) -> Self {
        let prefix = if self.prefix.is_empty() { name.to_owned() } else { format!("{}/{name}", self.prefix) };
        Self { prefix, ..self.clone() }
    }

    fn key(&self, name: &str) -> Key {
        key(&self.at(name).prefix)
    }

    /// Everything directly below.
    ///
    /// # Errors
    /// As the server says.
    pub fn list(&self) -> Result<Listing> {
        let prefix = (!self.prefix.is_empty()).then(|| key(&self.prefix));
        let listed = self.runtime.block_on(self.store.list_with_delimiter(prefix.as_ref()));
        let listed = listed.map_err(|e| self.failed("list", "", e))?;
        let name = |key: &Key| key.filename().map(str::to_owned);
        let mut all = Listing {
            folders: listed.common_prefixes.iter().filter_map(name).collect(),
            files: listed.objects.iter().filter_map(|o| Some((name(&o.location)?, o.size))).collect(),
        };
        all.folders.sort();
        all.files.sort();
        Ok(all)
    }

    /// Bytes of an object; `None` when it is not there.
    ///
    /// # Errors
    /// As the server says.
    pub fn size(&self, name: &str) -> Result<Option<u64>> {
        match self.runtime.block_on(self.store.head(&self.key(name))) {
            Ok(meta) => Ok(Some(meta.size)),
            Err(e) if is_absent(&e) => Ok(None),
            Err(e) => Err(self.failed("look for", name, e)),
        }
    }

    /// A small object; `None` when it is not there.
    ///
    /// # Errors
    /// As the server says.
    pub fn read(&self, name: &str) -> Result<Option<Vec<u8>>> {
        let get = async { self.store.get(&self.key(name)).await?.bytes().await };
        match self.runtime.block_on(get) {
            Ok(bytes) => Ok(Some(bytes.into())),
            Err(e) if is_absent(&e) => Ok(None),
            Err(e) => Err(self.failed("read", name, e)),
        }
    }

    /// Copies an object into the new file `to`.
    ///
    /// # Errors
    /// As the server and the file system say; also when the object changes meanwhile.
    pub fn fetch(&self, name: &str, to: &Path) -> Result<()> {
        let key = self.key(name);
        let failed = |e| self.failed("read", name, e);
        let meta = self.runtime.block_on(self.store.head(&key)).map_err(failed)?;
        let mut file = File::create_new(to).map_err(|e| Error::io("create", to, e))?;
        let mut at = 0;
        while at < meta.size {
            let range = at..meta.size.min(at + PART);
            at = range.end;
            let options = GetOptions {
                range: Some(GetRange::Bounded(range)),
                if_match: meta.e_tag.clone(),
                ..GetOptions::default()
            };
            let get = async { self.store.get_opts(&key, options).await?.bytes().await };
            let bytes = self.runtime.block_on(get).map_err(failed)?;
            file.write_all(&bytes).map_err(|e| Error::io("write", to, e))?;
        }
        Ok(())
    }

    /// Puts a small object, unless one is there; says whether it did.
    ///
    /// # Errors
    /// As the server says.
    pub fn put_new(&self, name: &str, bytes: &[u8]) -> Result<bool> {
        let key = self.key(name);
        let payload = PutPayload::from(bytes.to_vec());
        let mut tries = 0;
        loop {
            let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
            match self.runtime.block_on(self.store.put_opts(&key, payload.clone(), options)) {
                Ok(_) => return Ok(true),
                Err(object_store::Error::AlreadyExists { .. }) if self.size(name)?.is_some() => {
                    return Ok(false);
                }
                // The answer to requests that were in each other's way (409), too: then there may be nothing.
                Err(object_store::Error::AlreadyExists { .. }) if tries < RETRIES => tries += 1,
                Err(e) => return Err(self.failed("write", name, e)),
            }
            std::thread::sleep(CONFLICT_WAIT);
        }
    }

    /// Puts a file, unless an object of that name and size is there. A large one goes in parts: until the last of them is
    /// there, nothing is.
    ///
    /// # Errors
    /// [`ErrorKind::AlreadyExists`] when an object of another size is there; as the server and the file system say.
    pub fn put_file(&self, from: &Path, name: &str) -> Result<()> {
        let reading = |e| Error::reading("read", from, e);
        let mut file = depthrig_bus::files::open(from).map_err(reading)?;
        let size = file.metadata().map_err(reading)?.len();
        let mut next = |at: u64| {
            let mut part = vec![0; usize::try_from(PART.min(size - at)).unwrap_or(0)];
            file.read_exact(&mut part).map_err(reading)?;
            Ok::<_, Error>(part)
        };
        if size <= PART {
            if !self.put_new(name, &next(0)?)? {
                self.is_there(name, size)?;
            }
            return Ok(());
        }
        if self.is_there(name, size)? {
            return Ok(());
        }
        let failed = |e| self.failed("write", name, e);
        let key = self.key(name);
        let mut upload = self.runtime.block_on(self.store.put_multipart(&key)).map_err(failed)?;
        let sent = self.parts(&mut *upload, size, &mut next, name);
        // Another machine may have made the same meanwhile. A part of an upload has no condition, so this is looked at as late as
        // possible; whoever comes in between puts the same bytes.
        let is_there = sent.and_then(|()| self.is_there(name, size));
        if !matches!(is_there, Ok(false)) {
            // Parts that cannot be removed stay until the bucket's own rule removes them.
            drop(self.runtime.block_on(upload.abort()));
            return is_there.map(drop);
        }
        match self.runtime.block_on(upload.complete()) {
            // When the answer is lost and the request sent again, the server knows of no such upload any more.
            Err(e) if !self.is_there(name, size)? => Err(failed(e)),
            _ => Ok(()),
        }
    }

    /// Whether an object of this size is there.
    fn is_there(&self, name: &str, size: u64) -> Result<bool> {
        match self.size(name)? {
            None => Ok(false),
            Some(there) if there == size => Ok(true),
            Some(there) => Err(Error::new(
                ErrorKind::AlreadyExists,
                format!(
                    "{} has {there} bytes instead of {size}: another computer made it differently; use the same --threads and \
                     kind of CPU for all parts, or remove it",
                    self.at(name)
                ),
            )),
        }
    }

    fn parts(
        &self,
        upload: &mut dyn MultipartUpload,
        size: u64,
        next: &mut dyn FnMut(u64) -> Result<Vec<u8>>,
        name: &str,
    ) -> Result<()> {
        let mut at = 0;
        while at < size {
            let part = next(at)?;
            at += part.len() as u64;
            let put = upload.put_part(part.into());
            self.runtime.block_on(put).map_err(|e| self.failed("write", name, e))?;
        }
        Ok(())
    }

    /// An error of the server, with what to do about it.
    fn failed(&self, what: &str, name: &str, e: object_store::Error) -> Error {
        use object_store::Error as E;
        let said = e.to_string();
        let at = if name.is_empty() { self.to_string() } else { self.at(name).to_string() };
        let bucket = &self.bucket;
        let endpoint = &self.endpoint;
        let (kind, why) = match &e {
            E::NotFound { .. } if said.contains("NoSuchBucket") => (
                ErrorKind::NotFound,
                format!("{endpoint} has no bucket {bucket}; create it or correct its name"),
            ),
            E::NotFound { .. } => (ErrorKind::NotFound, "it does not exist".to_owned()),
            E::PermissionDenied { .. } | E::Unauthenticated { .. } => (
                ErrorKind::PermissionDenied,
                format!(
                    "{endpoint} denies access; check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_SESSION_TOKEN, and \
                     what they may do with the bucket {bucket}"
                ),
            ),
            E::Precondition { .. } => {
                (ErrorKind::Io, "it was changed while it was read; run it again".to_owned())
            }
            _ if said.contains("169.254.169.254") => (
                ErrorKind::PermissionDenied,
                "there are no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY".to_owned(),
            ),
            _ if said.contains("redirect") || said.contains("AuthorizationHeaderMalformed") => (
                ErrorKind::Io,
                format!("the bucket {bucket} is in another region; correct AWS_REGION or AWS_ENDPOINT_URL"),
            ),
            _ if said.contains("HTTP error") => (
                ErrorKind::Io,
                format!(
                    "{endpoint} does not answer, also when asked again; check AWS_ENDPOINT_URL and the network, then run it \
                     again"
                ),
            ),
            _ => (ErrorKind::Io, format!("{endpoint} refuses; run it again, or ask who runs it")),
        };
        Error::new(kind, format!("cannot {what} {at}: {why}")).with_source(e)
    }
}

/// A key as it is; one that `object_store` refuses, such as one with `..`, with these characters escaped.
fn key(text: &str) -> Key {
    Key::parse(text).unwrap_or_else(|_| Key::from(text))
}

/// Whether an object is not there, while its bucket is.
fn is_absent(e: &object_store::Error) -> bool {
    matches!(e, object_store::Error::NotFound { .. }) && !e.to_string().contains("NoSuchBucket")
}
