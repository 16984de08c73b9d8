//! One channel: a publish-subscribe service of bytes with a typed header, and an event service of the same
//! name that wakes waiting readers.
//!
//! The limits are the same for every channel of every rig, so that a daemon that comes back with another
//! configuration never meets an old subscriber that holds the channel in another form.

mod opening;

use crate::{Error, ErrorKind, Result, SCHEMA, limits, shm, umask};
use core::fmt::Debug;
use core::marker::PhantomData;
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use iceoryx2::port::listener::{Listener, ListenerCreateError, ListenerWaitError};
use iceoryx2::port::notifier::{Notifier, NotifierCreateError};
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{LoanError, ReceiveError};
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError as CreateError, PublishSubscribeOpenError as OpenError,
};
use iceoryx2::service::messaging_pattern::MessagingPattern;
use iceoryx2::service::port_factory::{event, publish_subscribe};
use opening::{OpenOrCreate, key, opened, value};
use std::sync::Arc;

/// The flavour of iceoryx2 whose ports and samples may move between threads; on the wire it is `ipc`.
pub type IoxService = ipc_threadsafe::Service;
pub type Loan<H> = SampleMutUninit<IoxService, [core::mem::MaybeUninit<u8>], H>;
pub type Received<H> = Sample<IoxService, [u8], H>;
type Factory<H> = publish_subscribe::PortFactory<IoxService, [u8], H>;
type EventFactory = event::PortFactory<IoxService>;

/// Subscribers of one channel at most, besides the daemon's own.
pub const MAX_SUBSCRIBERS: usize = 16;
/// Subscriber slots of a channel: every subscriber's, and the daemon's, which reads each stream for its sets.
const PLACES: usize = MAX_SUBSCRIBERS + 1;
/// Unread frames that the channel keeps per subscriber; older ones are replaced.
pub const BUFFER: usize = 4;
/// Frames that one subscriber may hold at once (frame stacks, sets being processed).
pub const MAX_HELD: usize = 16;
/// A camera's publisher, one that replaces a hung thread's, and one to spare.
const MAX_PUBLISHERS: usize = 3;
/// Frames of one channel that a device may be filling by itself at a time.
pub const MAX_LENT: usize = 8;
/// Loans of one publisher at a time: the frame that a driver is writing, and those that the device fills.
const MAX_LOANS: usize = 1 + MAX_LENT;
const MAX_NODES: usize = 32;
const NEW_FRAME: EventId = EventId::new(crate::external::EVENT_ID);

/// The limits of a channel, and the version of what travels on it. iceoryx2 fixes the limits while a process holds the
/// channel open, so every process must open it with the same ones.
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
    /// Slots without which it is not opened when memory is short.
    pub fewest_slots: usize,
}

/// The channels of a rig.
pub const RIG: Form = Form {
    schema: SCHEMA,
    publishers: MAX_PUBLISHERS,
    subscribers: PLACES,
    buffer: BUFFER,
    held: MAX_HELD,
    history: 1,
    nodes: MAX_NODES,
    notifiers: MAX_PUBLISHERS,
    listeners: PLACES,
    loans: MAX_LOANS,
    fewest_slots: shm::MIN_SLOTS,
};

/// A header type that can be sent over a channel.
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

    /// Opens the channel for writing and creates it if it does not exist. `starved` is set when no slot is free.
    pub fn sender(
        &self,
        node: &Node<IoxService>,
        max_bytes: usize,
        slots: usize,
        starved: &Arc<AtomicBool>,
    ) -> Result<Sender<H>> {
        let out = self.outlet(node, max_bytes, slots)?;
        Ok(Sender { out, notifier: self.notifier(node)?, starved: Arc::clone(starved) })
    }

    /// Opens the channel for reading; another process has created it.
    pub fn receiver(&self, node: &Node<IoxService>) -> Result<Receiver<H>> {
        let inlet = self.inlet(node, false)?;
        Ok(Receiver { inlet, listener: self.listener(node)? })
    }

    /// The writing end without the event, with memory behind every slot: `slots` of them, or as many as still fit into
    /// shared memory if these are at least [`Form::fewest_slots`].
    pub fn outlet(&self, node: &Node<IoxService>, max_bytes: usize, slots: usize) -> Result<Outlet<H>> {
        let service = self.service(node, true)?;
        let max_bytes = max_bytes.max(1);
        let mut slots = slots;
        loop {
            let port = self.publisher(&service, max_bytes, slots)?;
            let Some(lack) = shm::back(port.id().value(), slots)? else {
                let loans = self.form.loans;
                return Ok(Outlet { port, service, loans, slots, what: self.what.clone() });
            };
            // Its memory is free again before the next one is tried.
            drop(port);
            let fewer = lack.slots_that_fit()?;
            if fewer < self.form.fewest_slots.min(slots) || fewer >= slots {
                return Err(lack.refusal(&self.what, fewer));
            }
            tracing::warn!(
                channel = self.what,
                wanted = slots,
                slots = fewer,
                "another process took shared memory meanwhile, so it has fewer slots"
            );
            slots = fewer;
        }
    }

    fn publisher(
        &self,
        service: &Factory<H>,
        max_bytes: usize,
        slots: usize,
    ) -> Result<Publisher<IoxService, [u8], H>> {
        let builder = service
            .publisher_builder()
            .initial_max_slice_len(max_bytes)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(self.form.loans)
            .override_sample_preallocation(move |_| slots);
        builder.create().map_err(|e| {
            let taken = e == PublisherCreateError::ExceedsMaxSupportedPublishers;
            let no_memory = format!("no shared memory for {slots} slots of {max_bytes} bytes");
            let e_kind = if taken || limits::descriptors().is_some() {
                ErrorKind::LimitReached
            } else {
                ErrorKind::NoSpace
            };
            let taken = taken.then(|| format!("it has {} publishers already", self.form.publishers));
            let why = taken.unwrap_or_else(|| limits::why(&no_memory));
            Error::new(e_kind, format!("{} cannot be published: {why}", self.what)).with_source(e)
        })
    }

    /// The reading end without the event. With `make`, creates the channel if it does not exist.
    pub fn inlet(&self, node: &Node<IoxService>, make: bool) -> Result<Inlet<H>> {
        let service = self.service(node, make)?;
        let port = service.subscriber_builder().create().map_err(|e| {
            let taken = e == SubscriberCreateError::ExceedsMaxSupportedSubscribers;
            let taken = taken
                .then(|| format!("all of its {} places for subscribers are taken", self.form.subscribers));
            self.port_error(taken, "it cannot be subscribed to").with_source(e)
        })?;
        Ok(Inlet { port, service, held: self.form.held, what: self.what.clone() })
    }

    /// Opens the port that raises the channel's event.
    pub fn notifier(&self, node: &Node<IoxService>) -> Result<Notifier<IoxService>> {
        let events = self.event_service(node, &self.service_name()?)?;
        events.notifier_builder().default_event_id(NEW_FRAME).create().map_err(|e| {
            let taken = e == NotifierCreateError::ExceedsMaxSupportedNotifiers;
            let taken =
                taken.then(|| format!("all {} places to raise its event are taken", self.form.notifiers));
            self.port_error(taken, "its event cannot be raised").with_source(e)
        })
    }

    /// Opens the port that waits for the channel's event.
    pub fn listener(&self, node: &Node<IoxService>) -> Result<Listener<IoxService>> {
        let name = self.service_name()?;
        let events = self.event_service(node, &name)?;
        umask::apart(|| events.listener_builder().create()).map_err(|e| {
            let taken = e == ListenerCreateError::ExceedsMaxSupportedListeners;
            let taken =
                taken.then(|| format!("all {} places to listen to its event are taken", self.form.listeners));
            self.port_error(taken, "its event cannot be listened to").with_source(e)
        })
    }

    /// The error of a port that cannot be created: all places are `taken`, no file descriptors are left, or another
    /// cause.
    fn port_error(&self, taken: Option<String>, otherwise: &str) -> Error {
        let why = taken.unwrap_or_else(|| limits::why(otherwise));
        self.error(ErrorKind::LimitReached, &why)
    }

    fn service(&self, node: &Node<IoxService>, make: bool) -> Result<Factory<H>> {
        shm::check_room()?;
        let name = self.service_name()?;
        let form = self.form;
        let open = || {
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
        };
        let service = opened(node, &name, MessagingPattern::PublishSubscribe, open);
        let service = service.map_err(|e| self.open_error(&e))?;
        shm::back_registers()?;
        Ok(service)
    }

    fn event_service(&self, node: &Node<IoxService>, name: &ServiceName) -> Result<EventFactory> {
        shm::check_room()?;
        let open = || {
            node.service_builder(name)
                .event()
                .max_listeners(self.form.listeners)
                .max_notifiers(self.form.notifiers)
                .max_nodes(self.form.nodes)
                .open_or_create()
        };
        let events = opened(node, name, MessagingPattern::Event, open).map_err(|e| {
            self.error(ErrorKind::Other, &limits::why("its event service cannot be opened")).with_source(e)
        })?;
        shm::back_registers()?;
        Ok(events)
    }

    fn service_name(&self) -> Result<ServiceName> {
        self.name.as_str().try_into().map_err(|e| {
            self.error(ErrorKind::BadName, "its name is not a valid iceoryx2 service name").with_source(e)
        })
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
            OpenOrCreate::Other(why) => {
                (ErrorKind::Other, limits::why(&format!("it cannot be opened ({why})")))
            }
            other => (ErrorKind::Other, limits::why(&format!("it cannot be opened ({other:?})"))),
        };
        self.error(kind, &why)
    }
}

/// The writing end of a channel.
#[derive(Debug)]
pub struct Sender<H: Header> {
    out: Outlet<H>,
    notifier: Notifier<IoxService>,
    starved: Arc<AtomicBool>,
}

impl<H: Header> Sender<H> {
    /// A free slot with `len` bytes.
    pub fn loan(&self, len: usize) -> Result<Loan<H>> {
        self.out.loan(len).inspect_err(|e| {
            if e.kind() == ErrorKind::NoSpace {
                self.starved.store(true, Ordering::Relaxed);
            }
        })
    }

    /// Delivers the last sample to late joiners. Sending does it as well.
    pub fn welcome(&self) {
        self.out.welcome();
    }

    /// Subscribers of the channel, those included that have yet to be connected.
    pub fn subscribers(&self) -> usize {
        self.out.service.dynamic_config().number_of_subscribers()
    }

    /// Slots of shared memory that the channel has.
    pub const fn slots(&self) -> usize {
        self.out.slots
    }

    /// Publishes a slot whose every byte has been written, then wakes waiting readers. Never blocks on one.
    pub fn send(&self, loan: Loan<H>) -> Result<usize> {
        let receivers = self.out.send(loan)?;
        ring(&self.notifier, &self.out.what);
        Ok(receivers)
    }
}

/// Wakes the readers that wait for an event.
pub fn ring(notifier: &Notifier<IoxService>, what: &str) {
    // A reader that cannot be woken finds the frame after its next timeout.
    if let Err(e) = notifier.notify() {
        tracing::debug!(channel = what, error = ?e, "a subscriber could not be woken");
    }
}

/// Waits until the event is raised or `timeout` has passed. A signal counts as raised.
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
    service: Factory<H>,
    loans: usize,
    slots: usize,
    what: String,
}

impl<H: Header> Outlet<H> {
    /// A free slot with `len` bytes.
    pub fn loan(&self, len: usize) -> Result<Loan<H>> {
        let loan = match self.port.loan_slice_uninit(len) {
            Err(LoanError::OutOfMemory) => {
                // Only this takes back what dead subscribers held; sending does it too, but needs a slot first.
                self.welcome();
                self.port.loan_slice_uninit(len)
            }
            loan => loan,
        };
        loan.map_err(|e| {
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

    /// Connects the subscribers that joined, and disconnects those that left, since the last sample.
    fn welcome(&self) {
        if let Err(e) = self.port.update_connections() {
            tracing::debug!(channel = self.what, error = ?e, "a new subscriber could not be connected");
        }
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

    /// Waits until a sample is sent or `timeout` has passed. A signal counts as a sample.
    pub fn wait(&self, timeout: Duration) -> Result<()> {
        sleep(&self.listener, timeout, &self.inlet.what)
    }

    /// Whether the channel has a publisher.
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
