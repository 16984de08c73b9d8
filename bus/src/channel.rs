//! One channel: a publish-subscribe service of bytes with a typed header, and an event service of the same
//! name that wakes sleepers.
//!
//! The limits are the same for every channel of every rig, so that a daemon that comes back with another
//! configuration never meets an old subscriber that holds the channel in another form.

use crate::{Error, ErrorKind, Result, SCHEMA};
use core::fmt::Debug;
use core::marker::PhantomData;
use core::time::Duration;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{LoanError, ReceiveError};
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use iceoryx2::service::attribute;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError as CreateError, PublishSubscribeOpenError as OpenError,
    PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};
use iceoryx2::service::port_factory::{event, publish_subscribe};

/// The flavour of iceoryx2 whose ports and samples may move between threads; on the wire it is `ipc`.
pub type IoxService = ipc_threadsafe::Service;
pub type Loan<H> = SampleMutUninit<IoxService, [core::mem::MaybeUninit<u8>], H>;
pub type Received<H> = Sample<IoxService, [u8], H>;
type Factory<H> = publish_subscribe::PortFactory<IoxService, [u8], H>;
type EventFactory = event::PortFactory<IoxService>;

/// Subscribers of one channel at most.
pub const MAX_SUBSCRIBERS: usize = 16;
/// Unread frames that the channel keeps per subscriber; older ones are replaced.
pub const BUFFER: usize = 4;
/// Frames that one subscriber may hold at once (frame stacks, sets in flight).
pub const MAX_HELD: usize = 16;
/// A camera's publisher, one that replaces a hung thread's, and one to spare.
const MAX_PUBLISHERS: usize = 3;
/// Frames of one channel that a device may be filling by itself at a time.
pub const MAX_LENT: usize = 8;
/// Loans of one publisher at a time: the frame that a driver is writing, and those that the device fills.
const MAX_LOANS: usize = 1 + MAX_LENT;
const MAX_NODES: usize = 32;
const NEW_FRAME: EventId = EventId::new(crate::external::EVENT_ID);

/// The limits of a channel, and the version of what travels on it. iceoryx2 fixes the limits while anybody holds the
/// channel, so that all who open it must say the same.
#[derive(Debug, Clone, Copy)]
pub struct Form {
    pub schema: &'static str,
    pub publishers: usize,
    pub subscribers: usize,
    pub buffer: usize,
    pub held: usize,
    pub history: usize,
    pub nodes: usize,
    pub notifiers: usize,
    pub listeners: usize,
    /// Loans of one publisher at a time.
    pub loans: usize,
}

/// The channels of a rig.
pub const RIG: Form = Form {
    schema: SCHEMA,
    publishers: MAX_PUBLISHERS,
    subscribers: MAX_SUBSCRIBERS,
    buffer: BUFFER,
    held: MAX_HELD,
    history: 1,
    nodes: MAX_NODES,
    notifiers: MAX_PUBLISHERS,
    listeners: MAX_SUBSCRIBERS,
    loans: MAX_LOANS,
};

/// What a header type must be to travel.
pub trait Header: Debug + Default + Copy + ZeroCopySend + 'static {}
impl<T: Debug + Default + Copy + ZeroCopySend + 'static> Header for T {}

/// A channel by name, not yet opened. `what` names it in messages.
pub struct Channel<H> {
    name: String,
    what: String,
    form: Form,
    header: PhantomData<H>,
}

impl<H: Header> Channel<H> {
    pub const fn new(form: Form, name: String, what: String) -> Self {
        Self { name, what, form, header: PhantomData }
    }

    /// Opens the channel for writing, making it when it is not there.
    pub fn sender(&self, node: &Node<IoxService>, max_bytes: usize, slots: usize) -> Result<Sender<H>> {
        let out = self.outlet(node, max_bytes, slots)?;
        Ok(Sender { out, notifier: self.notifier(node)? })
    }

    /// Opens the channel for reading; somebody else has made it.
    pub fn receiver(&self, node: &Node<IoxService>) -> Result<Receiver<H>> {
        let inlet = self.inlet(node, false)?;
        Ok(Receiver { inlet, listener: self.listener(node)? })
    }

    /// What of the channel writes, without the event.
    pub fn outlet(&self, node: &Node<IoxService>, max_bytes: usize, slots: usize) -> Result<Outlet<H>> {
        let service = self.service(node, true)?;
        let (max_bytes, loans) = (max_bytes.max(1), self.form.loans);
        let port = service
            .publisher_builder()
            .initial_max_slice_len(max_bytes)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(loans)
            .override_sample_preallocation(move |_| slots)
            .create()
            .map_err(|e| {
                use iceoryx2::port::publisher::PublisherCreateError as E;
                let (kind, why) = match e {
                    E::ExceedsMaxSupportedPublishers => (
                        ErrorKind::LimitReached,
                        format!("it has {} publishers already", self.form.publishers),
                    ),
                    _ => (
                        ErrorKind::NoSpace,
                        format!("no shared memory for {slots} slots of {max_bytes} bytes"),
                    ),
                };
                Error::new(kind, format!("{} cannot be published: {why}", self.what)).with_source(e)
            })?;
        Ok(Outlet { port, loans, what: self.what.clone() })
    }

    /// What of the channel reads, without the event. With `make` it is made when it is not there.
    pub fn inlet(&self, node: &Node<IoxService>, make: bool) -> Result<Inlet<H>> {
        let service = self.service(node, make)?;
        let port = service.subscriber_builder().create().map_err(|e| {
            let why = format!("it has {} subscribers already", self.form.subscribers);
            self.error(ErrorKind::LimitReached, &why).with_source(e)
        })?;
        Ok(Inlet { port, service, held: self.form.held, what: self.what.clone() })
    }

    /// What raises the event of the channel.
    pub fn notifier(&self, node: &Node<IoxService>) -> Result<Notifier<IoxService>> {
        let events = self.event_service(node, &self.service_name()?)?;
        events
            .notifier_builder()
            .default_event_id(NEW_FRAME)
            .create()
            .map_err(|e| self.error(ErrorKind::LimitReached, "its event cannot be raised").with_source(e))
    }

    /// What sleeps until the event of the channel.
    pub fn listener(&self, node: &Node<IoxService>) -> Result<Listener<IoxService>> {
        let events = self.event_service(node, &self.service_name()?)?;
        events.listener_builder().create().map_err(|e| {
            self.error(ErrorKind::LimitReached, "its event cannot be listened to").with_source(e)
        })
    }

    fn service(&self, node: &Node<IoxService>, make: bool) -> Result<Factory<H>> {
        let (name, form) = (self.service_name()?, self.form);
        let opened = retry(|| {
            let schema = AttributeVerifier::new()
                .require(&key()?, &value(form.schema)?)
                .map_err(OpenOrCreate::attribute)?;
            let builder = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<H>();
            if !make {
                return builder.open_with_attributes(&schema).map_err(OpenOrCreate::Open);
            }
            builder
                .max_publishers(form.publishers)
                .max_subscribers(form.subscribers)
                .max_nodes(form.nodes)
                .subscriber_max_buffer_size(form.buffer)
                .subscriber_max_borrowed_samples(form.held)
                .history_size(form.history)
                .enable_safe_overflow(true)
                .open_or_create_with_attributes(&schema)
                .map_err(OpenOrCreate::from)
        });
        opened.map_err(|e| self.open_error(&e))
    }

    fn event_service(&self, node: &Node<IoxService>, name: &ServiceName) -> Result<EventFactory> {
        let mut last = None;
        for _ in 0..RETRIES {
            let opened = node
                .service_builder(name)
                .event()
                .max_listeners(self.form.listeners)
                .max_notifiers(self.form.notifiers)
                .max_nodes(self.form.nodes)
                .open_or_create();
            match opened {
                Ok(service) => return Ok(service),
                Err(e) => last = Some(e),
            }
            std::thread::sleep(RETRY_PAUSE);
        }
        let e = self.error(ErrorKind::Other, "its event service cannot be opened");
        Err(match last {
            Some(source) => e.with_source(source),
            None => e,
        })
    }

    fn service_name(&self) -> Result<ServiceName> {
        self.name
            .as_str()
            .try_into()
            .map_err(|e| self.error(ErrorKind::BadName, "its name is no service name").with_source(e))
    }

    fn error(&self, kind: ErrorKind, why: &str) -> Error {
        Error::new(kind, format!("{}: {why}", self.what))
    }

    fn open_error(&self, e: &OpenOrCreate) -> Error {
        const OTHER_VERSION: &str = "it was made by another version of depthrig or iceoryx2 (this is depthrig bus \
             version 1 on iceoryx2 0.10); run the daemon and its subscribers with the same version, and end programs \
             that still hold it in the other one";
        let (kind, why) = match e {
            OpenOrCreate::Open(OpenError::DoesNotExist) => {
                (ErrorKind::NotFound, "nobody publishes it".to_owned())
            }
            OpenOrCreate::Open(
                OpenError::IncompatibleTypes
                | OpenError::IncompatibleAttributes
                | OpenError::VersionMismatch
                | OpenError::ServiceInCorruptedState,
            ) => (ErrorKind::VersionMismatch, OTHER_VERSION.to_owned()),
            OpenOrCreate::Open(OpenError::InsufficientPermissions)
            | OpenOrCreate::Create(CreateError::InsufficientPermissions) => (
                ErrorKind::PermissionDenied,
                "it belongs to another user; daemon and subscribers run as one".to_owned(),
            ),
            OpenOrCreate::Open(OpenError::ExceedsMaxNumberOfNodes) => {
                (ErrorKind::LimitReached, format!("{} processes have it open already", self.form.nodes))
            }
            OpenOrCreate::Open(
                OpenError::DoesNotSupportRequestedMinBufferSize
                | OpenError::DoesNotSupportRequestedMinHistorySize
                | OpenError::DoesNotSupportRequestedMinSubscriberBorrowedSamples
                | OpenError::DoesNotSupportRequestedAmountOfPublishers
                | OpenError::DoesNotSupportRequestedAmountOfSubscribers
                | OpenError::DoesNotSupportRequestedAmountOfNodes
                | OpenError::IncompatibleOverflowBehavior,
            ) => (ErrorKind::InUse, "a process holds it open with other limits; end that process".to_owned()),
            OpenOrCreate::Other(why) => (ErrorKind::Other, format!("it cannot be opened ({why})")),
            other => (ErrorKind::Other, format!("it cannot be opened ({other:?})")),
        };
        self.error(kind, &why)
    }
}

/// Everything that opening or creating can fail with.
#[derive(Debug)]
pub enum OpenOrCreate {
    Open(OpenError),
    Create(CreateError),
    Other(String),
}

impl OpenOrCreate {
    fn attribute(e: impl Debug) -> Self {
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

const RETRIES: u32 = 20;
const RETRY_PAUSE: Duration = Duration::from_millis(20);

fn retry<T>(mut open: impl FnMut() -> Result<T, OpenOrCreate>) -> Result<T, OpenOrCreate> {
    for _ in 1..RETRIES {
        match open() {
            Err(e) if e.is_passing() => std::thread::sleep(RETRY_PAUSE),
            other => return other,
        }
    }
    open()
}

fn key() -> Result<attribute::AttributeKey, OpenOrCreate> {
    "schema".try_into().map_err(OpenOrCreate::attribute)
}

fn value(schema: &'static str) -> Result<attribute::AttributeValue, OpenOrCreate> {
    schema.try_into().map_err(OpenOrCreate::attribute)
}

/// The writing end of a channel.
#[derive(Debug)]
pub struct Sender<H: Header> {
    out: Outlet<H>,
    notifier: Notifier<IoxService>,
}

impl<H: Header> Sender<H> {
    /// A free slot with `len` bytes.
    pub fn loan(&self, len: usize) -> Result<Loan<H>> {
        self.out.loan(len)
    }

    /// Gives subscribers that came since the last sample that one. Sending does it as well.
    pub fn welcome(&self) {
        if let Err(e) = self.out.port.update_connections() {
            tracing::debug!(channel = self.out.what, error = ?e, "a new subscriber could not be connected");
        }
    }

    /// Publishes a slot whose every byte has been written, then wakes sleepers. Never blocks on one.
    pub fn send(&self, loan: Loan<H>) -> Result<usize> {
        let receivers = self.out.send(loan)?;
        ring(&self.notifier, &self.out.what);
        Ok(receivers)
    }
}

/// Wakes who sleeps on an event.
pub fn ring(notifier: &Notifier<IoxService>, what: &str) {
    // A sleeper that cannot be woken finds the frame at its next time-out.
    if let Err(e) = notifier.notify() {
        tracing::debug!(channel = what, error = ?e, "a subscriber could not be woken");
    }
}

/// Sleeps until the event is raised or `timeout` has passed. A signal counts as raised.
pub fn sleep(listener: &Listener<IoxService>, timeout: Duration, what: &str) -> Result<()> {
    match listener.timed_wait(|_| {}, timeout) {
        Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
        Err(e) => {
            Err(Error::new(ErrorKind::Other, format!("{what}: waiting for a frame failed")).with_source(e))
        }
    }
}

/// The writing end of a channel, without its event.
#[derive(Debug)]
pub struct Outlet<H: Header> {
    port: Publisher<IoxService, [u8], H>,
    loans: usize,
    what: String,
}

impl<H: Header> Outlet<H> {
    /// A free slot with `len` bytes.
    pub fn loan(&self, len: usize) -> Result<Loan<H>> {
        self.port.loan_slice_uninit(len).map_err(|e| {
            let (kind, why) = match e {
                LoanError::OutOfMemory => (ErrorKind::NoSpace, "subscribers hold every slot".to_owned()),
                LoanError::ExceedsMaxLoans => {
                    (ErrorKind::LimitReached, format!("{} frames are being written", self.loans))
                }
                LoanError::ExceedsMaxLoanSize => (
                    ErrorKind::LimitReached,
                    format!(
                        "a frame of {len} bytes is larger than its slots of {}",
                        self.port.initial_max_slice_len()
                    ),
                ),
                LoanError::InternalFailure => (ErrorKind::Other, "the slot cannot be lent".to_owned()),
            };
            Error::new(kind, format!("{}: {why}", self.what)).with_source(e)
        })
    }

    /// Publishes a slot whose every byte has been written. Wakes nobody.
    #[allow(unsafe_code)]
    pub fn send(&self, loan: Loan<H>) -> Result<usize> {
        // SAFETY: the payload is `[u8]` in memory that the kernel handed out zeroed, and every access to it goes
        // through `bytes_mut`, which only writes `u8`: each byte holds some `u8`, which is all that `u8` asks.
        let sample = unsafe { loan.assume_init() };
        sample.send().map_err(|e| {
            Error::new(ErrorKind::Other, format!("{}: the frame could not be sent", self.what)).with_source(e)
        })
    }

    /// The channel's name for messages.
    pub fn what(&self) -> &str {
        &self.what
    }
}

/// The bytes of a slot, for writing.
#[allow(unsafe_code)]
pub fn bytes_mut<H: Header>(loan: &mut Loan<H>) -> &mut [u8] {
    let slot = loan.payload_mut();
    // SAFETY: shared memory from the kernel is zeroed, so every byte is initialised from the start (an earlier
    // frame may have left others), and any value is a valid `u8`; pointer and length come from one slice.
    unsafe { core::slice::from_raw_parts_mut(slot.as_mut_ptr().cast::<u8>(), slot.len()) }
}

/// The reading end of a channel.
#[derive(Debug)]
pub struct Receiver<H: Header> {
    inlet: Inlet<H>,
    listener: Listener<IoxService>,
}

impl<H: Header> Receiver<H> {
    /// The oldest unread sample, if there is one.
    pub fn try_receive(&self) -> Result<Option<Received<H>>> {
        self.inlet.try_receive()
    }

    /// Sleeps until something was sent or `timeout` has passed. A signal counts as something sent.
    pub fn wait(&self, timeout: Duration) -> Result<()> {
        sleep(&self.listener, timeout, &self.inlet.what)
    }

    /// Whether anybody publishes at all.
    pub fn has_publisher(&self) -> bool {
        self.inlet.service.dynamic_config().number_of_publishers() > 0
    }

    /// The channel's name for messages.
    pub fn what(&self) -> &str {
        &self.inlet.what
    }
}

/// The reading end of a channel, without its event.
#[derive(Debug)]
pub struct Inlet<H: Header> {
    port: Subscriber<IoxService, [u8], H>,
    service: Factory<H>,
    held: usize,
    what: String,
}

impl<H: Header> Inlet<H> {
    /// The oldest unread sample, if there is one.
    pub fn try_receive(&self) -> Result<Option<Received<H>>> {
        self.port.receive().map_err(|e| {
            let (kind, why) = match e {
                ReceiveError::ExceedsMaxBorrows => (
                    ErrorKind::LimitReached,
                    format!("{} frames are held already; release one first", self.held),
                ),
                ReceiveError::ConnectionFailure(_) => {
                    (ErrorKind::Other, "the publisher's memory cannot be mapped".to_owned())
                }
            };
            Error::new(kind, format!("{}: {why}", self.what)).with_source(e)
        })
    }
}
