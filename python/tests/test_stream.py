"""Streams against a real publisher process: the Rust example, stepped frame by frame."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import depthrig
from depthrig import Frame, PixelFormat, Stream, _layout
from rig import WAIT_S, Publisher, assert_pixels, child

Start = Callable[..., Publisher]


def stream(folder: Path, name: str = "pattern/z16", **more: object) -> Stream:
    return Stream(name, runtime_dir=folder, timeout=WAIT_S, **more)  # type: ignore[arg-type]


def whole(frame: Frame) -> int:
    """The frame's number, after every one of its pixels was looked at."""
    assert_pixels(frame.array, frame.header)
    return frame.header.sequence


@pytest.mark.parametrize("pad", ["0", "6"])
@pytest.mark.many_streams
def test_every_format_arrives_bit_by_bit(start: Start, folder: Path, pad: str) -> None:
    publisher = start("--formats", "all", "--pad", pad)
    names = [f.name.lower() for f in PixelFormat]
    streams = [stream(folder, f"pattern/{n}") for n in names]
    assert depthrig.streams(runtime_dir=folder) == sorted(f"pattern/{n}" for n in names)
    publisher.publish(3)
    for s, name in zip(streams, names):
        for sequence in (1, 2, 3):
            frame = s.next(timeout=WAIT_S)
            h = frame.header
            assert whole(frame) == sequence
            assert frame.array.ctypes.data % _layout.HEADER_ALIGN == 0
            assert (h.rig, h.stream_id, h.format_name) == ("example", f"pattern/{name}", name)
            height = 1 if name == "motion" else 48
            assert (h.width, h.height, h.capture_time_ns) == (64, height, 1_000_000_000 + sequence * 33_333_333)
            assert h.captured == h.sequence + sum(h.drops.values())
            assert 0 < h.publish_time_ns <= time.monotonic_ns()
            assert h.intrinsics.fx == 611.1


def test_next_is_the_oldest_and_latest_the_newest(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    assert s.latest() is None
    publisher.publish(3)
    assert whole(s.next()) == 1
    newest = s.latest()
    assert newest is not None
    assert whole(newest) == 3
    assert s.latest() is None
    assert s.missed == 0, "skipped by choice is not missed"
    with pytest.raises(depthrig.Timeout, match=r"stream pattern/z16 of rig 'example': nothing came within 0\.05 s"):
        s.next(timeout=0.05)
    with pytest.raises(TimeoutError):
        s.next(timeout=0)


def test_a_slow_reader_loses_the_oldest_and_knows_how_many(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    publisher.publish(1)
    assert whole(s.next(WAIT_S)) == 1
    publisher.publish(19)
    assert whole(s.next(WAIT_S)) == 17
    assert s.missed == 15
    assert "#17, 15 missed" in repr(s)


def test_a_waiting_reader_is_woken(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    got: list[int] = []
    # A second thread runs while the first one waits: the wait holds no lock of Python's.
    reader = threading.Thread(target=lambda: got.extend(whole(s.next(WAIT_S)) for _ in range(20)))
    reader.start()
    for sequence in range(1, 21):
        publisher.publish()
        deadline = time.monotonic() + WAIT_S
        while len(got) < sequence and time.monotonic() < deadline:
            time.sleep(0.001)
    reader.join(WAIT_S)
    assert got == list(range(1, 21))


def test_pixels_stay_as_long_as_any_view_of_them(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    publisher.publish(1)
    frame = s.next(WAIT_S)
    header = frame.header
    views = [
        frame.array,
        frame.array[::2, ::3],
        frame.array.T,
        frame.array.reshape(-1)[5:],
        np.asarray(frame)[1:].view(np.uint8),
        np.lib.stride_tricks.sliding_window_view(frame.array, (2, 2)),
        np.frombuffer(memoryview(frame.array).cast("B"), np.uint8),
    ]
    for view in list(views):
        s2 = stream(folder)
        expected = view.copy()
        kept = [view]
        del view
        views.pop(0)
        for _ in range(200):
            publisher.publish(1)
            s2.latest()
        np.testing.assert_array_equal(kept[0], expected)
    # Now the same with everything else gone: one view alone, of a subscriber that was closed.
    array = frame.array
    del frame, kept, views
    s.close()
    del s
    gc.collect()
    other = stream(folder)
    for _ in range(200):
        publisher.publish(1)
        newest = other.latest()
        assert newest is not None
        assert newest.array.ctypes.data != array.ctypes.data
    assert_pixels(array, header)


def test_each_view_holds_one_slot_and_gives_it_back(start: Start, folder: Path) -> None:
    """The limit of 16 held frames counts for us: a leaked slot, or one given back early, would show."""
    publisher = start()
    s = stream(folder)
    makers: list[Callable[[Frame], object]] = [
        lambda f: f,
        lambda f: f.array,
        lambda f: np.asarray(f),
        lambda f: f.array[::2],
        lambda f: f.array.T,
        lambda f: f.array.reshape(-1),
        lambda f: (f.array, f.array[1:], f.array.T),
        lambda f: memoryview(f.array),
    ]
    for maker in makers:
        held = []
        for _ in range(16):
            publisher.publish(1)
            held.append(maker(s.next(WAIT_S)))
        publisher.publish(1)
        with pytest.raises(depthrig.HoldingTooMany):
            s.next(WAIT_S)
        held.pop()
        whole(s.next(WAIT_S))
        held.clear()
        s.latest()


def test_a_header_outlives_the_slot_of_its_frame(start: Start, folder: Path) -> None:
    """It is read lazily: letting go of the pixels must not leave it pointing at memory that another frame has now."""
    publisher = start()
    s = stream(folder)
    publisher.publish(1)
    with s.next(WAIT_S) as frame:
        pass
    other = stream(folder)
    for _ in range(200):
        publisher.publish(1)
        s.latest()
        other.latest()
    assert (frame.sequence, frame.header.sequence) == (1, 1)
    assert frame.header.capture_time_ns == frame.capture_time_ns == 1_033_333_333


def test_what_is_not_held_takes_no_slot(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    kept = []
    for _ in range(50):
        publisher.publish(1)
        frame = s.next(WAIT_S)
        kept.append((frame.header, frame.copy(), frame.depth_m(), repr(frame)))
    for header, copy, _, _ in kept:
        assert_pixels(copy, header)


def test_held_frames_keep_their_own_pixels(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    held = []
    for _ in range(16):
        publisher.publish(1)
        frame = s.next(WAIT_S)
        held.append((frame.header, frame.array))
    del frame
    publisher.publish(100)
    with pytest.raises(depthrig.HoldingTooMany, match=r"holds 16 frames.*delete frames and arrays.*frame\.copy\(\)"):
        s.latest()
    for header, array in held:
        assert_pixels(array, header)
    held.pop(0)
    assert whole(s.next(WAIT_S)) == 113, "the ring kept the newest four"
    newest = s.latest()
    assert newest is not None
    assert whole(newest) == 116, "with 15 held, the newest is reached through the one slot that is left"


def test_views_may_die_in_other_threads(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    held: list[object] = []
    for _ in range(100):
        publisher.publish(1)
        held.append(s.next(WAIT_S).array)
        if len(held) == 8:
            killer = threading.Thread(target=held.clear)
            killer.start()
            killer.join()
    publisher.publish(1)
    whole(s.next(WAIT_S))


def run(code: str, folder: Path, **more: object) -> subprocess.CompletedProcess[str]:
    """Runs `code` in a fresh interpreter, where a crash is an exit status."""
    program = (
        f"import depthrig, numpy as np\nS = lambda n: depthrig.Stream(n, runtime_dir={str(folder)!r}, timeout=20)\n"
    )
    command = [sys.executable, "-c", program + textwrap.dedent(code)]
    return subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S * 2, check=False, **more)  # type: ignore[call-overload,no-any-return]


def test_writing_is_an_error_and_no_crash(binary: str, folder: Path) -> None:
    free = subprocess.Popen([binary, str(folder), "--fps", "100"], stdout=subprocess.PIPE)
    try:
        code = """
            frame = S("pattern/z16").next(timeout=20)
            a = frame.array
            for write in (lambda: a.__setitem__(0, 1), lambda: a.fill(0), lambda: a.sort(), lambda: np.copyto(a, 1),
                          lambda: a.setflags(write=True), lambda: np.add(a, 1, out=a), lambda: a.byteswap(True)):
                try:
                    write()
                except ValueError:
                    print("refused")
        """
        done = run(code, folder)
    finally:
        free.kill()
        free.wait()
    assert (done.returncode, done.stdout, done.stderr) == (0, "refused\n" * 7, "")


def test_arrays_may_outlive_everything_at_exit(binary: str, folder: Path) -> None:
    free = subprocess.Popen([binary, str(folder), "--fps", "100"], stdout=subprocess.PIPE)
    try:
        code = """
            import builtins
            stream = S("pattern/z16")
            builtins.kept = [stream.next(timeout=20).array for _ in range(3)]
            stream.close()
            print(len(builtins.kept))
        """
        done = run(code, folder)
    finally:
        free.kill()
        free.wait()
    assert (done.returncode, done.stdout, done.stderr) == (0, "3\n", ""), "and iceoryx2 says nothing on stderr"


def test_ctrl_c_ends_a_wait(start: Start, folder: Path) -> None:
    start()  # publishes nothing, so the wait is endless
    code = f"""
    import depthrig
    s = depthrig.Stream("pattern/z16", runtime_dir={str(folder)!r}, timeout=20)
    try:
        print("waiting", flush=True)
        s.next()
    except KeyboardInterrupt:
        print("interrupted")
    """
    with child([sys.executable, "-c", textwrap.dedent(code)]) as waiting:
        assert waiting.stdout is not None
        assert waiting.stdout.readline() == "waiting\n"
        time.sleep(0.2)
        waiting.send_signal(signal.SIGINT)
        out, err = waiting.communicate(timeout=WAIT_S)
    assert (out, err, waiting.returncode) == ("interrupted\n", "", 0)


@pytest.mark.parametrize("end", ["stop", "kill"])
def test_the_end_of_the_publisher_is_an_error_and_its_return_is_not(start: Start, folder: Path, end: str) -> None:
    first = start()
    s = stream(folder)
    first.publish(2)
    assert whole(s.next(WAIT_S)) == 1
    getattr(first, end)()
    assert whole(s.next(WAIT_S)) == 2, "what was published is still read"
    with pytest.raises(depthrig.StreamGone, match="pattern/z16 .*nobody publishes it any more"):
        s.next(timeout=WAIT_S)
    with pytest.raises(depthrig.StreamGone):
        s.next()
    assert not s.is_live
    second = start()
    second.publish(1)
    assert whole(s.next(WAIT_S)) == 1
    assert s.is_live
    assert s.missed == 0
    second.publish(2)
    assert [whole(s.next(WAIT_S)) for _ in range(2)] == [2, 3]


def test_a_late_reader_gets_the_newest_frame_at_the_next_publish(start: Start, folder: Path) -> None:
    publisher = start()
    publisher.publish(5)
    late = stream(folder)
    publisher.publish(1)
    assert [whole(late.next(WAIT_S)) for _ in range(2)] == [5, 6]
    assert late.missed == 0


def test_readers_do_not_disturb_each_other(start: Start, folder: Path) -> None:
    publisher = start()
    one, two = stream(folder), stream(folder)
    held = []
    for sequence in range(1, 41):
        publisher.publish(1)
        assert whole(one.next(WAIT_S)) == sequence
        if len(held) < 16:
            held.append(two.next(WAIT_S))
    assert [whole(f) for f in held] == list(range(1, 17))
    assert one.missed == 0


def test_iterating(start: Start, folder: Path) -> None:
    publisher = start()
    publisher.publish(1)
    with stream(folder) as s:
        publisher.publish(3)
        seen = []
        for frame in s:
            seen.append(whole(frame))
            if len(seen) == 4:
                break
        assert seen == [1, 2, 3, 4]
        publisher.stop()
        with pytest.raises(depthrig.StreamGone):
            next(s)
    assert list(s) == [], "a closed stream has nothing to iterate"
    with pytest.raises(ValueError, match="closed"):
        s.latest()
    s.close()
    assert "closed" in repr(s)


def test_an_unknown_stream_names_those_there_are(start: Start, folder: Path) -> None:
    start()
    with pytest.raises(depthrig.StreamNotFound, match="the rig has: pattern/rgb8, pattern/z16"):
        Stream("pattern/colour", runtime_dir=folder, timeout=0.1)


def test_a_reader_can_come_before_its_rig(binary: str, folder: Path) -> None:
    found: list[Stream] = []
    early = threading.Thread(target=lambda: found.append(stream(folder)))
    early.start()
    time.sleep(0.1)
    with Publisher(binary, folder) as publisher:
        early.join(WAIT_S)
        publisher.publish(1)
        assert whole(found[0].next(WAIT_S)) == 1


def test_the_only_rig_is_found_and_two_must_be_named(start: Start, folder: Path) -> None:
    first = start(rig="left")
    s = stream(folder)
    assert s.rig == "left"
    second = start(rig="right")
    with pytest.raises(depthrig.AmbiguousRig, match="left, right"):
        Stream("pattern/z16", runtime_dir=folder, timeout=0)
    named = stream(folder, rig="right")
    first.publish(2)
    second.publish(1)
    assert named.next(WAIT_S).header.rig == "right"
    assert named.latest() is None


def test_a_forked_child_must_open_its_own(start: Start, folder: Path) -> None:
    publisher = start()
    publisher.publish(1)
    code = """
        import os
        s = S("pattern/z16")
        child = os.fork()
        if child == 0:
            try:
                s.latest()
            except depthrig.BusError as e:
                print(e, flush=True)
            os._exit(0)
        os.waitpid(child, 0)
    """
    done = run(code, folder)
    assert done.returncode == 0
    assert "was opened before this process was forked" in done.stdout


def test_sets_name_their_frames(start: Start, folder: Path) -> None:
    publisher = start()
    sets = depthrig.Sets(runtime_dir=folder, timeout=WAIT_S)
    assert sets.latest() is None
    publisher.publish(2)
    for set_id in (1, 2):
        got = sets.next(WAIT_S)
        t = 1_000_000_000 + set_id * 33_333_333
        assert (got.set_id, got.tick_ns, got.spread_ns, got.incomplete) == (set_id, t, 1234, set_id)
        assert got.members == {"pattern/missing": None, "pattern/rgb8": set_id, "pattern/z16": set_id}
        assert list(got.members) == ["pattern/missing", "pattern/rgb8", "pattern/z16"]
        assert got.capture_times_ns == {"pattern/rgb8": t, "pattern/z16": t}
        assert got.missing == ["pattern/missing"]
        assert not got.is_complete
    publisher.publish(30)
    newest = sets.latest()
    assert newest is not None
    assert newest.set_id == 32
    publisher.kill()
    with pytest.raises(depthrig.StreamGone, match="sets"):
        sets.next(WAIT_S)


def test_shared_memory_is_not_left_behind(start: Start, folder: Path) -> None:
    publisher = start()
    s = stream(folder)
    publisher.publish(1)
    frame = s.next(WAIT_S)
    used = {name for name in os.listdir("/dev/shm") if name.startswith("depthrig_")}
    publisher.stop()
    del frame
    s.close()
    del s
    gc.collect()
    left = {name for name in used if os.path.exists(f"/dev/shm/{name}")}
    # This rig's files are gone; other rigs of the machine may come and go meanwhile.
    assert used - left
