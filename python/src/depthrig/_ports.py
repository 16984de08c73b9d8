"""Channels that either side may open first, so both create them alike: the second module that uses iceoryx2.

They are those of the hand-shake with the daemon (docs/external.md has the settings) and of signals.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import iceoryx2 as iox2

from . import _layout as layout
from ._bus import _OTHER_VERSION, _PASSING, BINDING, Bus, _header_type, _retry
from ._memory import back, check_room, out_of_descriptors
from .errors import BusError, VersionMismatch

OFFER = _header_type(layout.EXTERNAL_OFFER_TYPE, layout.EXTERNAL_OFFER_SIZE, layout.EXTERNAL_ALIGN)
ANSWER = _header_type(layout.EXTERNAL_ANSWER_TYPE, layout.EXTERNAL_ANSWER_SIZE, layout.EXTERNAL_ALIGN)
FRAME = _header_type(layout.EXTERNAL_FRAME_TYPE, layout.EXTERNAL_FRAME_SIZE, layout.EXTERNAL_ALIGN)
SIGNAL = _header_type(layout.SIGNAL_HEADER_TYPE, layout.SIGNAL_HEADER_SIZE, layout.SIGNAL_HEADER_ALIGN)

# One frame being written, and two on loan at the same time.
_LOANS = 3


class Form(NamedTuple):
    """The limits of a channel. iceoryx2 fixes them while a process holds it open, so all open it with the same ones."""

    schema: str
    publishers: int
    subscribers: int
    buffer: int
    held: int
    history: int
    nodes: int
    notifiers: int
    listeners: int
    what: str
    """What a process does with its writing end, for messages."""


TALK = Form(
    layout.EXTERNAL_SCHEMA,
    layout.EXTERNAL_MAX_PUBLISHERS,
    layout.EXTERNAL_MAX_SUBSCRIBERS,
    layout.EXTERNAL_BUFFER,
    layout.EXTERNAL_MAX_HELD,
    1,
    layout.EXTERNAL_MAX_NODES,
    layout.EXTERNAL_MAX_EVENT_PORTS,
    layout.EXTERNAL_MAX_EVENT_PORTS,
    "serve the camera",
)
FRAMES = TALK._replace(history=0)
SIGNALS = Form(
    layout.SIGNAL_SCHEMA,
    layout.SIGNAL_MAX_PUBLISHERS,
    layout.SIGNAL_MAX_SUBSCRIBERS,
    layout.SIGNAL_BUFFER,
    layout.SIGNAL_MAX_HELD,
    1,
    layout.SIGNAL_MAX_NODES,
    layout.SIGNAL_MAX_PUBLISHERS,
    layout.SIGNAL_MAX_SUBSCRIBERS,
    "publish the signal",
)


def _service(bus: Bus, name: str, header: type[ctypes.Structure], form: Form) -> Any:
    """Open or create a channel."""
    check_room()
    schema = iox2.AttributeVerifier.new().require(
        iox2.AttributeKey.new("schema"), iox2.AttributeValue.new(form.schema)
    )

    def attempt() -> Any:
        builder = bus.node.service_builder(iox2.ServiceName.new(name))
        builder = builder.publish_subscribe(iox2.Slice[ctypes.c_uint8]).user_header(header)
        builder = builder.max_publishers(form.publishers).max_subscribers(form.subscribers)
        builder = builder.subscriber_max_buffer_size(form.buffer).subscriber_max_borrowed_samples(form.held)
        builder = builder.max_nodes(form.nodes).history_size(form.history).enable_safe_overflow(True)
        return builder.open_or_create_with_attributes(schema)

    try:
        return _retry(attempt, iox2.PublishSubscribeOpenOrCreateError, _PASSING)
    except iox2.PublishSubscribeOpenOrCreateError as e:
        raise _open_error(name, str(e)) from e


def _events(bus: Bus, name: str, form: Form) -> Any:
    """Open or create the event of a channel."""
    check_room()

    def attempt() -> Any:
        builder = bus.node.service_builder(iox2.ServiceName.new(name)).event()
        builder = builder.max_notifiers(form.notifiers).max_listeners(form.listeners)
        return builder.max_nodes(form.nodes).open_or_create()

    try:
        return _retry(attempt, iox2.EventOpenOrCreateError, _PASSING)
    except iox2.EventOpenOrCreateError as e:
        raise _open_error(name, str(e)) from e


def _open_error(name: str, why: str) -> BusError | VersionMismatch:
    if any(part in why for part in _OTHER_VERSION):
        return VersionMismatch(
            f"channel {name} was made by another version of depthrig or iceoryx2 ({why}); install the `depthrig` "
            "package of the daemon's version, and restart programs that still hold the channel in the other one"
        )
    cure = out_of_descriptors() or "is the folder this user's?"
    return BusError(f"channel {name} cannot be opened ({why}); {cure}")


class Slot:
    """A slot of shared memory on loan; sent, or given back when it is forgotten."""

    __slots__ = ("_sample", "address", "header_address", "length")

    def __init__(self, sample: Any, length: int) -> None:
        self._sample = sample
        self.address: int = sample.payload_ptr
        self.header_address: int = sample.user_header_ptr
        self.length = length

    def send(self) -> int:
        """Send it and return how many received it. The slot is unusable afterwards."""
        sample, self._sample = self._sample, None
        if sample is None:
            raise ValueError("this slot was sent already")
        return int(sample.send())


class Sender:
    """The writing end of a channel."""

    def __init__(self, bus: Bus, name: str, header: type[ctypes.Structure], length: int, slots: int, form: Form):
        self.name = name
        self._service = _service(bus, name, header, form)
        builder = self._service.publisher_builder().initial_max_slice_len(max(length, 1))
        builder = builder.allocation_strategy(iox2.AllocationStrategy.Static).max_loaned_samples(_LOANS)
        try:
            self._publisher = builder.override_sample_preallocation(slots).create()
        except iox2.PublisherCreateError as e:
            cure = out_of_descriptors() or f"does another process still {form.what}?"
            raise BusError(f"channel {name} cannot be written ({e}): {slots} slots of {length} bytes; {cure}") from e
        back(self._publisher.id.value, slots, name)

    def loan(self, length: int) -> Slot | None:
        """Lend a slot of `length` bytes; return None when the other side holds them all."""
        try:
            try:
                sample = self._publisher.loan_slice_uninit(length)
            except iox2.LoanError as e:
                if str(e) != "OutOfMemory":
                    raise
                # Only this takes back what a killed reader held; sending does it too, but needs a slot first.
                self._publisher.update_connections()
                sample = self._publisher.loan_slice_uninit(length)
            return Slot(sample.assume_init(), length)
        except iox2.LoanError as e:
            if str(e) in ("OutOfMemory", "ExceedsMaxLoans"):
                return None
            raise BusError(f"channel {self.name}: no slot of {length} bytes can be had ({e})") from e
        except iox2.ConnectionFailure:
            return None  # a reader that is not yet complete; the next frame tries again

    def send_copy(self, header: int, header_length: int, payload: int, length: int) -> bool:
        """Send a copy of a header and a payload at these addresses; return whether there was a slot for it."""
        slot = self.loan(length)
        if slot is None:
            return False
        ctypes.memmove(slot.header_address, header, header_length)
        ctypes.memmove(slot.address, payload, length)
        try:
            slot.send()
        except iox2.SendError as e:
            raise BusError(f"channel {self.name}: a sample could not be sent ({e})") from e
        return True

    def welcome(self) -> None:
        """Connect readers that joined since the last sample, which they receive."""
        try:
            self._publisher.update_connections()
        except iox2.ConnectionFailure:
            return  # a reader that is not yet complete; the next sample tries again


class Bell:
    """Wakes the readers that wait for a channel."""

    def __init__(self, bus: Bus, name: str, form: Form) -> None:
        self._events = _events(bus, name, form)
        event = iox2.EventId.new(layout.EXTERNAL_EVENT_ID)
        try:
            self._notifier = self._events.notifier_builder().default_event_id(event).create()
        except iox2.NotifierCreateError as e:
            raise BusError(f"the event of channel {name} cannot be raised ({e})") from e

    def ring(self) -> None:
        """Wake them. No reader, or a reader with a full queue, is not an error: then it is awake."""
        try:
            self._notifier.notify()
        except iox2.NotifierNotifyError:
            return


class Letters:
    """The reading end of a channel of messages, of which the newest one counts."""

    def __init__(self, bus: Bus, name: str, header: type[ctypes.Structure], header_size: int) -> None:
        self.name = name
        self._size = header_size
        self._service = _service(bus, name, header, TALK)
        self._events = _events(bus, name, TALK)
        try:
            self._subscriber = self._service.subscriber_builder().create()
            with BINDING:
                self._listener = self._events.listener_builder().create()
        except (iox2.SubscriberCreateError, iox2.ListenerCreateError) as e:
            raise BusError(f"channel {name} cannot be read ({e}); {out_of_descriptors() or 'try again'}") from e

    def take(self) -> tuple[bytes, bytes] | None:
        """Return the oldest unread message's header and payload, or None."""
        try:
            sample = self._subscriber.receive()
        except (iox2.ReceiveError, iox2.ConnectionFailure) as e:
            raise BusError(f"channel {self.name} cannot be read ({e})") from e
        if sample is None:
            return None
        header = ctypes.string_at(sample.user_header_ptr, self._size)
        return header, ctypes.string_at(sample.payload_ptr, sample.header.number_of_elements)

    def wait(self, seconds: float) -> None:
        """Wait until a message is sent or `seconds` have passed, without Python's lock."""
        try:
            self._listener.timed_wait(iox2.Duration.from_nanos(max(0, int(seconds * 1e9))))
        except iox2.ListenerWaitError as e:
            if str(e) != "InterruptSignal":
                raise BusError(f"channel {self.name}: waiting failed ({e})") from e
