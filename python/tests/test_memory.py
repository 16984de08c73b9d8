"""The writing end in Python: slots that a killed reader held, allocated memory, named limits."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from depthrig import BusError, _memory
from depthrig._bus import Bus
from depthrig._layout import SHM_PREFIX
from depthrig._ports import FRAME, FRAMES, Sender
from rig import WAIT_S

SLOTS = 6
LENGTH = 100_000
CHANNEL = "depthrig.external/mount/front/frames/color"
HOLD = f"""
import sys, time
from depthrig import _layout
from depthrig._bus import Bus
from depthrig._ports import FRAME, FRAMES, _service
service = _service(Bus.at(sys.argv[1]), {CHANNEL!r}, FRAME, FRAMES)
subscriber = service.subscriber_builder().create()
print("ready", flush=True)
held = []
while len(held) < 4:
    sample = subscriber.receive()
    if sample is None:
        time.sleep(0.002)
    else:
        held.append(sample)
print("holding", flush=True)
time.sleep(1000)
"""


def send(sender: Sender) -> bool:
    slot = sender.loan(LENGTH)
    if slot is None:
        return False
    slot.send()
    return True


@pytest.mark.parametrize("kills", [3])
def test_slots_of_a_killed_reader_come_back(folder: Path, kills: int) -> None:
    bus = Bus.at(str(folder))
    sender = Sender(bus, CHANNEL, FRAME, LENGTH, SLOTS, FRAMES)
    for _ in range(kills):
        reader = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
        assert reader.stdout is not None
        try:
            assert reader.stdout.readline().strip() == "ready"
            for _ in range(4):
                assert send(sender)
            assert reader.stdout.readline().strip() == "holding"
            while send(sender):
                pass
        finally:
            reader.kill()
            reader.wait(WAIT_S)
            reader.stdout.close()
        bus.clean_dead()
        assert all(send(sender) for _ in range(20))


def test_every_slot_has_memory(folder: Path) -> None:
    sender = Sender(Bus.at(str(folder)), CHANNEL, FRAME, LENGTH, SLOTS, FRAMES)
    ending = f"_{sender._publisher.id.value}.data"
    (name,) = [n for n in os.listdir("/dev/shm") if n.startswith(SHM_PREFIX) and n.endswith(ending)]
    stat = os.stat(f"/dev/shm/{name}")
    assert stat.st_size > SLOTS * LENGTH
    assert stat.st_blocks * 512 >= stat.st_size


def test_slots_without_room_are_refused(folder: Path) -> None:
    free = _memory._free()
    assert free is not None
    with pytest.raises(BusError, match=f"no room for its {SLOTS} slots .* would fit; enlarge"):
        Sender(Bus.at(str(folder)), CHANNEL, FRAME, free // 4, SLOTS, FRAMES)


def test_being_out_of_descriptors_is_said() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    used = len(os.listdir("/proc/self/fd"))
    assert _memory.out_of_descriptors() is None
    resource.setrlimit(resource.RLIMIT_NOFILE, (used + 4, hard))
    try:
        why = _memory.out_of_descriptors()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert why is not None
    assert f"of at most {used + 4} file descriptors open" in why
