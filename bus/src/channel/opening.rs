//! Opens or creates the services of a channel while other processes do the same, or were killed doing it.

use crate::HostTime;
use crate::channel::IoxService;
use core::fmt::Debug;
use core::time::Duration;
use iceoryx2::node::Node;
use iceoryx2::service::attribute;
use iceoryx2::service::builder::event::{EventOpenError, EventOpenOrCreateError};
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError as CreateError, PublishSubscribeOpenError as OpenError,
    PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};
use iceoryx2::service::internal::ServiceInternal;
use iceoryx2::service::messaging_pattern::MessagingPattern;
use iceoryx2::service::service_name::ServiceName;

const RETRIES: u32 = 20;
const RETRY_PAUSE: Duration = Duration::from_millis(20);
/// Creating or removing a service takes microseconds; one that stays incomplete for this long is abandoned.
const HALF: Duration = Duration::from_secs(1);

/// Why a service cannot be opened or created now.
pub(super) trait Failure {
    /// Whether it passes by itself: another process is just making or removing the service.
    fn is_passing(&self) -> bool;

    /// Whether the service is half created or half removed, and nobody can use it.
    fn is_half(&self) -> bool;
}

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
}

impl Failure for OpenOrCreate {
    fn is_passing(&self) -> bool {
        self.is_half()
            || matches!(
                self,
                Self::Open(OpenError::InternalFailure)
                    | Self::Create(CreateError::IsBeingCreatedByAnotherInstance)
                    | Self::Other(_)
            )
    }

    fn is_half(&self) -> bool {
        matches!(
            self,
            Self::Open(OpenError::IsMarkedForDestruction | OpenError::HangsInCreation)
                | Self::Create(CreateError::HangsInCreation)
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

impl Failure for EventOpenOrCreateError {
    fn is_passing(&self) -> bool {
        true
    }

    fn is_half(&self) -> bool {
        matches!(
            self,
            Self::EventOpenError(EventOpenError::IsMarkedForDestruction | EventOpenError::HangsInCreation)
        )
    }
}

/// Opens or creates the service `name` of `node` with `open`, again while it is in a state that passes. Removes it first
/// if it stays half created or half removed.
///
/// Whoever leaves a service last locks it, forgets that it had it, and only then removes its files. A process that is
/// killed in between leaves files of which no dead process knows, and a channel that nobody can open any more.
#[allow(unsafe_code)]
pub(super) fn opened<T, E: Failure>(
    node: &Node<IoxService>,
    name: &ServiceName,
    pattern: MessagingPattern,
    open: impl Fn() -> Result<T, E>,
) -> Result<T, E> {
    let failure = match retry(&open) {
        Err(e) if e.is_half() => e,
        other => return other,
    };
    // SAFETY: nobody uses the service: it can be neither opened nor joined in this state. A process that is alive leaves it
    // within microseconds, and it lasted for [`HALF`] or all of the retries.
    let removed = unsafe { IoxService::__internal_force_remove_service(name, node.config(), pattern) };
    if !matches!(removed, Ok(true)) {
        return Err(failure);
    }
    tracing::warn!(channel = %name, "removed the incomplete channel that a killed process had left behind");
    retry(open)
}

fn retry<T, E: Failure>(open: impl Fn() -> Result<T, E>) -> Result<T, E> {
    // An attempt may wait by itself for what hangs.
    let until = HostTime::now().plus(HALF);
    for _ in 1..RETRIES {
        match open() {
            Err(e) if e.is_half() && until.from_now().is_zero() => return Err(e),
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
