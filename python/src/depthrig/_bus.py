"""Opens channels for reading and maps errors of iceoryx2 to ours. Only this module and _ports.py use it."""

from __future__ import annotations

import ctypes
import os
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any, ClassVar

from . import _layout
from ._memory import check_room, out_of_descriptors
from .errors import BusError, DepthrigError, HoldingTooMany, VersionMismatch

_PIP = "pip install 'iceoryx2==0.10.*'"
_WHEEL = "0.10."

try:
    import iceoryx2 as iox2
except ImportError as e:
    raise ImportError(
        f"depthrig reads shared memory with the iceoryx2 wheel, which cannot be imported ({e}); {_PIP} "
        "(there are wheels for x86-64 Linux with glibc 2.34 or later; elsewhere pip builds it and needs Rust)"
    ) from e

# iceoryx2 changes the umask of the whole process while it binds the socket of a listener: two threads that do it at
# once could leave a umask with which new folders cannot be entered.
BINDING = threading.Lock()
# How long another process may take to finish creating a channel.
_TIMEOUT_S = 1.0
_PASSING = ("IsMarkedForDestruction", "HangsInCreation", "InternalFailure")
_OTHER_VERSION = (
    "IncompatibleTypes",
    "IncompatibleAttributes",
    "VersionMismatch",
    "ServiceInCorruptedState",
)


def _header_type(name: str, size: int, align: int) -> type[ctypes.Structure]:
    """Make the type that iceoryx2 compares with Rust's header: name, size and alignment.

    A channel may be opened with a smaller alignment than it has; samples then lie as they were written. ctypes cannot
    ask for more than a field has before Python 3.13.
    """

    class HeaderType(ctypes.Structure):
        _fields_ = (("words", ctypes.c_uint64 * (size // 8)),)

        @staticmethod
        def type_name() -> str:
            return name

    if ctypes.sizeof(HeaderType) != size or ctypes.alignment(HeaderType) > align:
        raise ImportError(f"{name} cannot be laid out as in Rust on this machine")
    return HeaderType


FRAME_HEADER = _header_type(_layout.HEADER_TYPE, _layout.HEADER_SIZE, _layout.HEADER_ALIGN)
SET_HEADER = _header_type(_layout.SET_HEADER_TYPE, _layout.SET_HEADER_SIZE, _layout.SET_HEADER_ALIGN)


def check_wheel(version: str) -> None:
    """Raise VersionMismatch unless the installed iceoryx2 is compatible with the daemon's."""
    if not version.startswith(_WHEEL):
        raise VersionMismatch(
            f"the installed iceoryx2 wheel is version {version}, depthrig {_layout.SCHEMA} needs 0.10: {_PIP}"
        )


def wheel_version() -> str:
    """Return the version of the installed iceoryx2 wheel."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("iceoryx2")
    except PackageNotFoundError:  # imported from a folder; the channels themselves will refuse another version
        return _WHEEL


# How often this process and its ancestors were forked since they loaded this module.
_forks = 0


def _forked() -> None:
    global _forks
    _forks += 1


os.register_at_fork(after_in_child=_forked)


class Bus:
    """This process's place on the bus of one runtime folder, shared by all its channels."""

    _open: ClassVar[weakref.WeakValueDictionary[tuple[int, str], Bus]] = weakref.WeakValueDictionary()

    def __init__(self, folder: str) -> None:
        check_wheel(wheel_version())
        # Its errors come back as errors; its log would go to the user's stderr.
        iox2.set_log_level(iox2.LogLevel.Fatal)
        self.folder = folder
        check_room()
        # In code, because iceoryx2 would otherwise read config/iceoryx2.toml of the working folder.
        config = iox2.config.default()
        parts = config.global_cfg
        try:
            parts.root_path = iox2.Path.new(os.path.join(folder, _layout.IOX_FOLDER))
            parts.prefix = iox2.FileName.new(_layout.SHM_PREFIX)
            parts.creation_timeout = iox2.Duration.from_millis(500)
            self.config = config
            self.node = (
                iox2.NodeBuilder.new()
                .config(config)
                .signal_handling_mode(iox2.SignalHandlingMode.Disabled)  # Ctrl-C is Python's
                .create(iox2.ServiceType.Ipc)
            )
        except (iox2.NodeCreationFailure, iox2.SemanticStringError) as e:
            what = out_of_descriptors() or "run as the daemon's user"
            raise BusError(f"the bus in {folder} cannot be joined ({e}); {what}") from e

    @classmethod
    def at(cls, folder: str) -> Bus:
        """Return the bus of `folder`, joining it when this process has not yet."""
        key = (os.getpid(), folder)
        bus = cls._open.get(key)
        if bus is None:
            bus = cls._open[key] = cls(folder)
        return bus

    def streams(self, rig: str) -> list[str]:
        """List the streams of `rig` that have a publisher or a subscriber now, sorted."""
        prefix = f"depthrig/{rig}/"
        found = []
        for details in iox2.Service.list(self.config, iox2.ServiceType.Ipc):
            name: str = details.name().to_string()
            is_channel = str(details.messaging_pattern()) == "PublishSubscribe"
            if is_channel and name.startswith(prefix) and name.count("/") == 3:
                found.append(name[len(prefix) :])
        return sorted(found)

    def clean_dead(self) -> None:
        """Free what killed processes left behind; until then a killed publisher counts as one."""
        self.node.try_cleanup_dead_nodes()


class Receiver:
    """The reading end of one channel, whose publisher has created it. `missing` makes the error when there is none."""

    def __init__(
        self,
        bus: Bus,
        channel: str,
        schema: str,
        header: type[ctypes.Structure],
        what: str,
        missing: Callable[[], DepthrigError],
    ) -> None:
        self.bus = bus
        self.what = what
        self._forks = _forks
        self._waitset: tuple[Any, Any] | None = None
        name = iox2.ServiceName.new(channel)
        attributes = iox2.AttributeVerifier.new().require(
            iox2.AttributeKey.new("schema"), iox2.AttributeValue.new(schema)
        )

        def open_service() -> Any:
            builder = bus.node.service_builder(name).publish_subscribe(iox2.Slice[ctypes.c_uint8])
            return builder.user_header(header).open_with_attributes(attributes)

        try:
            self._service = _retry(open_service, iox2.PublishSubscribeOpenError, _PASSING)
        except iox2.PublishSubscribeOpenError as e:
            raise missing() if str(e) == "DoesNotExist" else self._open_error(str(e), schema) from e
        check_room()
        # The publisher creates the channel first and its event right after.
        event_passing = (*_PASSING, "DoesNotExist")
        try:
            events = _retry(lambda: bus.node.service_builder(name).event().open(), iox2.EventOpenError, event_passing)
            self._subscriber: Any | None = self._service.subscriber_builder().create()
            with BINDING:
                self._listener: Any | None = events.listener_builder().create()
        except iox2.EventOpenError as e:
            raise BusError(f"{what}: its event cannot be opened ({e})") from e
        except (iox2.SubscriberCreateError, iox2.ListenerCreateError) as e:
            if str(e).startswith("ExceedsMaxSupported"):
                limit = self._service.static_config.max_subscribers
                raise BusError(f"{what}: all of its {limit} places for subscribers are taken; end one of them") from e
            raise BusError(f"{what}: it cannot be subscribed to ({e}); {out_of_descriptors() or 'try again'}") from e

    def _open_error(self, why: str, schema: str) -> DepthrigError:
        if why in _OTHER_VERSION:
            return VersionMismatch(
                f"{self.what}: it was made by another version of depthrig or iceoryx2 ({why}); this package reads "
                f"{schema} with iceoryx2 {wheel_version()}; install the `depthrig` package of the daemon's "
                "version, and restart programs that still hold the stream in the other one"
            )
        if why == "InsufficientPermissions":
            return BusError(f"{self.what}: it belongs to another user; daemon and subscribers run as one")
        if why == "ExceedsMaxNumberOfNodes":
            return BusError(f"{self.what}: too many processes have it open already; end one of them")
        return BusError(f"{self.what}: it cannot be opened ({out_of_descriptors() or why})")

    def receive(self) -> Any | None:
        """Return the oldest unread sample, or None."""
        if self._subscriber is None:
            raise ValueError(f"{self.what} was closed")
        if _forks != self._forks:
            raise BusError(f"{self.what} was opened before this process was forked; open it in the process that reads")
        try:
            return self._subscriber.receive()
        except iox2.ReceiveError as e:
            if str(e) == "ExceedsMaxBorrows":
                limit = self._service.static_config.subscriber_max_borrowed_samples
                raise HoldingTooMany(
                    f"{self.what}: this subscriber holds {limit} frames, the most it may; delete frames and arrays "
                    "that are no longer needed, or keep copies (frame.copy())"
                ) from None
            raise BusError(f"{self.what}: a frame cannot be received ({e})") from e
        except iox2.ConnectionFailure as e:
            raise BusError(f"{self.what}: the publisher's memory cannot be mapped ({e})") from e

    def has_unread(self) -> bool:
        """Whether another sample waits."""
        return self._subscriber is not None and bool(self._subscriber.has_samples())

    def wait(self, seconds: float) -> None:
        """Wait until a sample is sent or `seconds` have passed, without Python's lock."""
        if self._listener is None:
            raise ValueError(f"{self.what} was closed")
        try:
            self._listener.timed_wait(iox2.Duration.from_nanos(max(0, int(seconds * 1e9))))
        except iox2.ListenerWaitError as e:
            if str(e) != "InterruptSignal":  # the signal's own handler runs when this returns
                raise BusError(f"{self.what}: waiting for a frame failed ({e})") from e

    def rest(self, nanoseconds: int) -> bool:
        """Sleep for so long, to a tenth of a millisecond; return whether nothing was sent meanwhile.

        :meth:`wait` rounds up to the kernel's ticks of 4 ms, this to milliseconds; what is over a millisecond is slept
        first, when a frame is least likely.
        """
        if self._listener is None:
            raise ValueError(f"{self.what} was closed")
        try:
            if self._waitset is None:
                builder = iox2.WaitSetBuilder.new().signal_handling_mode(iox2.SignalHandlingMode.Disabled)
                waitset = builder.create(iox2.ServiceType.Ipc)
                self._waitset = (waitset, waitset.attach_notification(self._listener))
            self._listener.try_wait()  # notifications of frames that were read already
            millis, over = divmod(nanoseconds, 1_000_000)
            time.sleep(over / 1e9)
            if self.has_unread():
                return False
            came, _ = self._waitset[0].wait_and_process_with_timeout(iox2.Duration.from_millis(millis))
            return not came
        except (
            iox2.ListenerWaitError,
            iox2.WaitSetCreateError,
            iox2.WaitSetAttachmentError,
            iox2.WaitSetRunError,
        ):
            return False  # a signal, whose handler runs when this returns; the next wait reports all else

    def has_publisher(self) -> bool:
        """Whether the channel has a publisher now; cleans up after killed publishers first."""
        self.bus.clean_dead()
        return bool(self._service.dynamic_config.number_of_publishers > 0)

    def close(self) -> None:
        """Stop receiving. Samples that are held stay valid."""
        self._waitset = None
        self._subscriber = None
        self._listener = None

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called."""
        return self._subscriber is None


def _retry(attempt: Any, error: type[Exception], passing: tuple[str, ...]) -> Any:
    """Try again while another process is creating or removing the service."""
    deadline = time.monotonic() + _TIMEOUT_S
    while True:
        try:
            return attempt()
        except error as e:
            if str(e) not in passing or time.monotonic() >= deadline:
                raise
        time.sleep(0.02)
