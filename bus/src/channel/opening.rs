//! Opening or creating the service of a channel, while other processes do the same.

use core::fmt::Debug;
use core::time::Duration;
use iceoryx2::service::attribute;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError as CreateError, PublishSubscribeOpenError as OpenError,
    PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};

/// Everything that opening or creating can fail with.
#[derive(Debug)]
pub(super) enum OpenOrCreate {
    Open(OpenError),
    Create(CreateError),
    Other(String),
}

impl OpenOrCreate {
    pub(super) fn attribute(e: impl Debug) -> Self {
        Self::Other(format!("{e:?}"))
    }

    /// States that pass by themselves: another process is just making or removing the service.
    const fn is_passing(&self) -> bool {
        matches!(
            self,
            Self::Open(
                OpenError::IsMarkedForDestruction | OpenError::HangsInCreation | OpenError::InternalFailure
            ) | Self::Create(CreateError::IsBeingCreatedByAnotherInstance | CreateError::HangsInCreation)
                | Self::Other(_)
        )
    }
}

impl From<OpenOrCreateError> for OpenOrCreate {
    fn from(e: OpenOrCreateError) -> Self {
        match e {
            OpenOrCreateError::PublishSubscribeOpenError(e) => Self::Open(e),
            OpenOrCreateError::PublishSubscribeCreateError(e) => Self::Create(e),
            other @ OpenOrCreateError::SystemInFlux => Self::Other(format!("{other:?}")),
        }
    }
}

pub(super) const RETRIES: u32 = 20;
pub(super) const RETRY_PAUSE: Duration = Duration::from_millis(20);

pub(super) fn retry<T>(mut open: impl FnMut() -> Result<T, OpenOrCreate>) -> Result<T, OpenOrCreate> {
    for _ in 1..RETRIES {
        match open() {
            Err(e) if e.is_passing() => std::thread::sleep(RETRY_PAUSE),
            other => return other,
        }
    }
    open()
}

pub(super) fn key() -> Result<attribute::AttributeKey, OpenOrCreate> {
    "schema".try_into().map_err(OpenOrCreate::attribute)
}

pub(super) fn value(schema: &'static str) -> Result<attribute::AttributeValue, OpenOrCreate> {
    schema.try_into().map_err(OpenOrCreate::attribute)
}
