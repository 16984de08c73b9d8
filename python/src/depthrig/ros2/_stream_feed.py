"""A stream of images as `Image`, `CompressedImage`, `CameraInfo` and `PointCloud2`, and an IMU as `Imu`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Union

from .._frame import Frame
from .._header import Header
from .._stream import Stream
from ..errors import Timeout
from . import _cloud, _images, _messages, _names, _types
from ._clock import Clock
from ._feed import SLICE_S, Feed
from ._names import Qos
from ._node import Node, Publisher
from ._poses import Poses

_Encode = Callable[[Frame, Any], Union[bytes, bytearray]]


class _Output(NamedTuple):
    publisher: Publisher
    encode: _Encode


class StreamFeed(Feed):
    """The topics of one stream."""

    def __init__(self, node: Node, rig: str, folder: str, name: str, clock: Clock, poses: Poses) -> None:
        super().__init__(node, name)
        self._rig = rig
        self._folder = folder
        self._clock = clock
        self._poses = poses
        self._frame_id = ""
        self.read = 0
        """Frames that were read, the first one included, which is read for its header."""

    def serve(self) -> None:
        """Read one header for format and pose, announce the topics, and publish while somebody subscribes."""
        header = self._first_header()
        if header is None:
            return
        is_motion = header.width > 0 and header.format_name == "motion"
        self._frame_id = _names.stream_frame(header.camera, header.stream, is_motion)
        self._poses.place(self._frame_id, header.pose)
        outputs = [self._output(*declared) for declared in _topics(header, is_motion)]
        while not self.stopped:
            if any(output.publisher.wanted for output in outputs):
                with self._open() as stream:
                    self._publish(stream, outputs, is_motion)
            else:
                self.wait_for_change()

    def _open(self) -> Stream:
        return Stream(self.name, self._rig, self._folder, timeout=0.0, prepare=False)

    def _first_header(self) -> Header | None:
        with self._open() as stream:
            while not self.stopped:
                try:
                    with stream.next(SLICE_S) as frame:
                        self.read += 1
                        return frame.header
                except Timeout:
                    continue
        return None

    def _output(self, last: str, ros_type: str, encode: _Encode) -> _Output:
        topic = f"/{self._rig}/{self.name}/{last}"
        publisher = self.node.publisher(topic, ros_type, Qos.SENSOR, self.wake)
        self.publishers.append(publisher)
        return _Output(publisher, encode)

    def _publish(self, stream: Stream, outputs: list[_Output], is_motion: bool) -> None:
        """Publish until nobody subscribes any more."""
        last, missed = 0, 0
        while not self.stopped:
            wanted = [output for output in outputs if output.publisher.wanted]
            if not wanted:
                return
            try:
                frame = stream.next(SLICE_S)
            except Timeout:
                continue
            # Of images the newest, of an IMU every batch.
            if not is_motion and (newest := stream.latest()) is not None:
                frame.release()
                frame = newest
            with frame:
                self.read += 1
                self._poses.place(self._frame_id, frame.header.pose)
                if is_motion:
                    # First the count: who has a sample then finds counted what is missing before it.
                    wanted[0].publisher.count.missed += (stream.missed - missed) * frame.header.width
                    missed = stream.missed
                    self._publish_batch(frame, wanted[0].publisher)
                    continue
                skipped = frame.sequence - last - 1 if 0 < last < frame.sequence else 0
                last = frame.sequence
                stamp = _types.header(self._clock.utc_ns(frame.capture_time_ns), self._frame_id)
                for output in wanted:
                    output.publisher.count.skipped += skipped
                    output.publisher.put(output.encode(frame, stamp))

    def _publish_batch(self, frame: Frame, publisher: Publisher) -> None:
        for sample in frame.motion:
            stamp = _types.header(self._clock.utc_ns(int(sample["time_ns"])), self._frame_id)
            publisher.put(_messages.imu(sample, stamp))


def _topics(header: Header, is_motion: bool) -> list[tuple[str, str, _Encode]]:
    """Return the last part, the type and the encoder of each topic of a stream. The cheapest are encoded first."""
    if is_motion:
        return [("data_raw", _types.IMU, lambda frame, stamp: b"")]
    if not _images.is_image(header):
        return []
    topics: list[tuple[str, str, _Encode]] = [
        ("camera_info", _types.CAMERA_INFO, lambda frame, stamp: _images.camera_info(frame.header, stamp)),
        ("image_raw", _types.IMAGE, _images.raw),
    ]
    if _images.is_color(header):
        topics.append(("image_raw/compressed", _types.COMPRESSED, _images.jpeg))
    if _images.is_depth16(header):
        topics.append(("image_raw/compressedDepth", _types.COMPRESSED, _images.compressed_depth))
    if header.is_depth and header.intrinsics.is_known:
        topics.append(("points", _types.POINTS, _cloud.points))
    return topics
