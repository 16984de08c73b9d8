"""A session of two computers: one start, parts pulled over OpenSSH, cut wires and killed daemons, one joined dataset."""

from __future__ import annotations

import filecmp
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from random import Random
from typing import Any

import pytest
from test_daemon import CAMERAS, DATA, ROOT, WAIT_S, binary  # noqa: F401
from test_link_clock import SHIFT_NS
from test_two_hosts import PERIOD_NS, messages

sys.path.insert(0, str(ROOT / "tests/link"))
from hosts import TwoHosts, wait_for, why_not

HOST_CAMERAS = {"here": CAMERAS[:2], "there": CAMERAS[3:]}
NAMES = {"here": "right", "there": "left"}


class Rig:
    """A daemon on each of two computers, and what one says to them."""

    def __init__(self, hosts: TwoHosts, binary: str, folder: Path, runtime: Path, *, mirror: Sequence[str] = (), refine: str = "", more: str = "") -> None:  # noqa: F811
        """The streams `mirror` of the other computer come here, where `refine` is what else is said of it; `more` is the end of its rig file."""
        self.hosts = hosts
        self.binary = binary
        self.folder = folder
        self.runtime = {host: runtime / host for host in NAMES}
        self.daemons: dict[str, subprocess.Popen[bytes]] = {}
        for path in self.runtime.values():
            path.mkdir(mode=0o700)
        left = self.runtime["there"] / "mount.sock"
        ssh = hosts.serve_ssh()
        links = {
            "here": f'listen = "10.77.0.1:7447"\n[[link.hosts]]\nname = "left"\nssh = "{ssh}"\nsocket = "{left}"\n'
            f"mirror = {json.dumps(mirror)}\n{refine}",
            "there": 'recorder = "10.77.0.1:7447"',
        }
        for host, name in NAMES.items():
            lines = ['rig = "mount"', "[link]", f'host = "{name}"', links[host]]
            lines += ["[control]", 'tcp = "off"', "[recording]", f'directory = "{self.data(host)}"']
            lines += ["reserve_mb = 64", "min_minutes = 0"]
            for camera in HOST_CAMERAS[host]:
                manifest = json.dumps(str(ROOT / "tests" / "data" / f"{camera.name}.toml"))
                lines += ["[[camera]]", f'name = "{camera.name}"', 'backend = "files"', f"manifest = {manifest}"]
            lines += [more] if host == "there" else []
            self.rig_file(host).write_text("\n".join(lines) + "\n")

    def rig_file(self, host: str) -> Path:
        return self.folder / f"{host}.toml"

    def data(self, host: str) -> Path:
        return self.folder / host

    def log(self, host: str) -> str:
        return (self.folder / f"{host}.log").read_text()

    def start(self, host: str, within: Sequence[str] = ()) -> None:
        """Starts the daemon of a host, by the command `within`, and waits for its cameras."""
        self.daemons[host] = self.hosts.start(
            host,
            self.folder / f"{host}.log",
            *within,
            self.binary,
            "run",
            str(self.rig_file(host)),
            DEPTHRIG_RUNTIME_DIR=str(self.runtime[host]),
            DEPTHRIG_TEST_DATA=str(DATA),
        )
        wait_for(f"the daemon {host}", lambda: self.ask("status", host=host, codes=(0, 1, 3)))
        if host == "there" and "here" in self.daemons:
            self.wait_for_host("connected")
        wait_for("its cameras", lambda: all(camera["state"] == "streaming" for camera in self.status(host)["cameras"]))

    def kill(self, host: str) -> None:
        self.daemons[host].send_signal(signal.SIGKILL)
        self.daemons[host].wait()

    def ask(self, *arguments: str, host: str = "here", codes: tuple[int, ...] = (0,)) -> str:
        command = (self.binary, *arguments)
        return self.hosts.run(host, *command, codes=codes, DEPTHRIG_RUNTIME_DIR=str(self.runtime[host]))

    def status(self, host: str = "here") -> dict[str, Any]:
        return json.loads(self.ask("status", "--json", host=host, codes=(0, 3)))

    def host(self) -> dict[str, Any]:
        (left,) = self.status()["hosts"]["hosts"]
        return left

    def wait_for_host(self, state: str, seconds: float = WAIT_S) -> dict[str, Any]:
        def found() -> dict[str, Any] | None:
            left = self.host()
            return left if left["state"] == state else None

        return wait_for(f"host left is {state}: {self.host()}", found, seconds)

    def session(self) -> dict[str, Any]:
        return self.status()["hosts"]["session"]

    def joined(self) -> Path:
        """The dataset of the newest session, when it is joined."""

        def found() -> str | None:
            session = self.session()
            assert session["joined"] != "failed", session["why"]
            return session["dataset"]

        return self.data("here") / str(wait_for("joined", found))


@contextmanager
def two_computers(binary: str, folder: Path, rate: str = "1gbit", **more: Any) -> Iterator[Rig]:  # noqa: F811
    """Both computers, joined by a wire of `rate`, with `more` of their rig."""
    if why := why_not():
        pytest.skip(why)
    # Short: sockets lie below it.
    with tempfile.TemporaryDirectory(prefix="h", dir="/tmp", ignore_cleanup_errors=True) as name:
        runtime = Path(name)
        # The server's user is another one where the tests run as root.
        for path in (folder, runtime):
            os.chmod(path, 0o700)
        with TwoHosts(folder, SHIFT_NS, rate) as hosts:
            yield Rig(hosts, binary, folder, runtime, **more)


@pytest.fixture
def rig(binary: str, tmp_path: Path) -> Iterator[Rig]:  # noqa: F811
    with two_computers(binary, tmp_path) as rig:
        yield rig


def images(dataset: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for topic, value, _ in messages(dataset):
        if hasattr(value, "data") and hasattr(value, "header"):
            found.setdefault(topic, []).append(bytes(value.data))
    return found


def check_joined(rig: Rig, joined: Path, own: Path, parts: list[Path]) -> None:
    """Every image of all parts is in the joined dataset, and each part here is that of its computer."""
    for part in parts:
        there = rig.data("there") / part.name
        files = sorted(p.name for p in there.iterdir() if p.suffix == ".mcap" or p.name == "session.toml")
        assert filecmp.cmpfiles(there, part, files, shallow=False) == (files, [], [])
    expected = images(own)
    for part in parts:
        for topic, data in images(part).items():
            expected.setdefault(topic, []).extend(data)
    assert images(joined) == expected
    findings = json.loads(rig.ask("verify", "--decode", "--json", str(joined), codes=(0, 3)))["findings"]
    assert [f for f in findings if f["severity"] == "broken"] == []
    assert not (rig.data("here") / ".pulling").exists()
    assert not (rig.data("here") / ".joining").exists()


def test_one_start_records_both_and_their_parts_become_one_dataset(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    wait_for("the clock", lambda: rig.host()["has_clock"])
    # The first ticks of both lie where the cameras of each have them.
    time.sleep(3)
    said = rig.ask("record", "start", "--name", "kitchen", "--scene", "kitchen", "--operator", "ada")
    assert "host left: recording kitchen_left" in said
    assert rig.status("there")["recording"]["name"] == "kitchen_left"
    rig.ask("record", "note", "the cup was moved")
    rig.ask("episode", "start", "--task", "pour")
    wait_for("sets of both", lambda: all(rig.status(host)["recording"]["sets"] >= 25 for host in NAMES))
    # Parts are pulled while they are recorded.
    wait_for("bytes", lambda: rig.session()["parts"][0]["pulled_bytes"] > 0)
    # What speaks to a daemon speaks to the other one in the same way.
    assert json.loads(rig.ask("status", "--json", "--host", "left", codes=(0, 3)))["link"]["host"] == "left"
    rig.ask("episode", "stop")
    rig.ask("record", "stop", codes=(0, 3))
    assert not rig.status("there")["recording"]["active"]
    joined = rig.joined()
    own, part = (rig.data("here") / name for name in ("kitchen", "kitchen_left"))
    check_joined(rig, joined, own, [part])
    session = tomllib.loads((joined / "session.toml").read_text())
    assert (session["scene"], session["operator"]) == ("kitchen", "ada")
    assert [n["text"] for n in session["notes"]] == ["the cup was moved"]
    assert [e["task"] for e in session["episodes"]] == ["pour"]
    full = [v for topic, v, _ in messages(joined) if topic == "/mount/frame_set" and not v.missing]
    assert len(full) >= 15
    # Ticks of both lie on one grid, where the recorder put it for the cameras of both; while it moves it, by 2 ms a tick, the other one is a second
    # late at most. Grids of their own clocks would be 90 ms apart.
    ticks = {path: [v.tick_ns for topic, v, _ in messages(path) if topic == "/mount/frame_set"] for path in (own, part)}
    # The other one began a little before the recorder, and ended a little after it.
    both = [t - SHIFT_NS for t in ticks[part] if ticks[own][0] <= t - SHIFT_NS <= ticks[own][-1]]
    assert len(both) >= 15
    # So each is where the grid was at some time shortly before.
    near = [[t - other for other in ticks[own] if -PERIOD_NS < t - other < 2_000_000_000] for t in both]
    nearest = [min(min(apart % PERIOD_NS, -apart % PERIOD_NS) for apart in of_tick) for of_tick in near if of_tick]
    assert max(nearest) < 5_000_000, nearest
    # By hand the same comes out again, and nothing that exists is overwritten.
    again = rig.folder / "again"
    rig.ask("merge", "--hosts", str(again), str(own))
    assert images(again) == images(joined)
    assert "exists" in rig.hosts.run(
        "here", "sh", "-c", f"{rig.binary} merge --hosts {again} {own} 2>&1", codes=(1,), DEPTHRIG_RUNTIME_DIR=str(rig.runtime["here"])
    )
    assert "[link]" not in rig.log("here")
    # A recording of the same name would have parts of the same names, and the old result.
    for path in (own, part):
        shutil.rmtree(path)
    said = rig.hosts.run(
        "here", "sh", "-c", f"{rig.binary} record start --name kitchen 2>&1", codes=(1,), DEPTHRIG_RUNTIME_DIR=str(rig.runtime["here"])
    )
    assert "kitchen_joined belongs to an earlier recording kitchen; choose another --name" in said
    assert joined.is_dir() and not own.exists()


def test_a_part_without_the_clock_is_not_joined_by_utc(rig: Rig) -> None:
    # As behind a firewall that lets OpenSSH pass and no UDP.
    text = rig.rig_file("there").read_text()
    rig.rig_file("there").write_text(text.replace(":7447", ":7448"))
    rig.start("here")
    rig.start("there")
    said = rig.ask("record", "start", "--name", "blind", codes=(3,))
    assert "host left: recording blind_left, its clock is not known yet" in said
    time.sleep(2)
    rig.ask("status", codes=(3,))
    rig.ask("record", "stop", codes=(0, 3))
    wait_for("word of it", lambda: rig.session()["joined"] == "failed")
    assert "blind_left has no clock of the session" in rig.session()["why"]
    assert not (rig.data("here") / "blind_joined").exists()
    # Who knows how exactly both clocks were set may say so.
    own, part = (rig.data("here") / name for name in ("blind", "blind_left"))
    rig.ask("replay", str(own), str(part), "--as-fast-as-possible", "--rig", "again", "--record", str(rig.folder / "by_utc"), codes=(0, 3))
    assert list((rig.folder / "by_utc").rglob("session.toml"))


def test_doctor_measures_the_way_before_a_session(rig: Rig) -> None:
    def found() -> dict[str, str]:
        report = json.loads(rig.ask("doctor", "--json", str(rig.rig_file("here")), codes=(0, 1, 2, 3)))
        return {f["id"]: f["what"] for f in report["findings"]}

    def is_measured() -> bool:
        way = found().get("host_reached", "")
        numbers = re.fullmatch(r"host left: (\d+) MB/s from there, (\d+) MB/s to there, round trip (\d+\.\d) ms", way)
        # The wire has 1 Gbit/s, 125 MB/s; bytes that the kernels hold are counted as sent.
        return bool(numbers and all(8 < int(rate) <= 300 for rate in numbers.groups()[:2]) and float(numbers[3]) < 100)

    # The server may still be starting, and a busy computer is slower once.
    wait_for("a way", is_measured)
    assert "host left: its daemon does not answer: " in found()["host_silent"]
    # Nobody is asked to stop for it.
    rig.start("there")
    wait_for("an answer from there", lambda: "host_silent" not in found())
    assert "host_refused" not in found()
    assert not list(rig.runtime["here"].glob("*@left*")), "nothing stays of the way to its socket"
    rig.hosts.cut()
    assert "host left is not reached: ssh left: " in found()["host_unreachable"]


def test_a_cut_wire_loses_nothing(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    rig.ask("record", "start", "--name", "cut")
    time.sleep(2)
    rig.hosts.cut()
    lost = rig.wait_for_host("absent", 10)
    assert "ssh left" in lost["why"] or "does not answer" in lost["why"], lost
    assert rig.status()["recording"]["active"]
    time.sleep(4)
    rig.hosts.heal()
    rig.wait_for_host("connected", 20)
    time.sleep(2)
    rig.ask("record", "stop", codes=(0, 3))
    joined = rig.joined()
    check_joined(rig, joined, rig.data("here") / "cut", [rig.data("here") / "cut_left"])
    # The other computer recorded all the time, though a busy one leaves out some frames.
    lacks = [bool(v.missing) for topic, v, _ in messages(joined) if topic == "/mount/frame_set"]
    assert max((len(list(run)) for is_lacking, run in groupby(lacks) if is_lacking), default=0) < 15, "for 3 s of the cut"


def test_a_host_that_is_killed_has_two_parts(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    rig.ask("record", "start", "--name", "killed")
    time.sleep(3)
    rig.kill("there")
    rig.wait_for_host("absent", 10)
    rig.start("there")
    wait_for("a second part", lambda: rig.host()["recording"] == "killed_left_2")
    time.sleep(3)
    rig.ask("record", "stop", codes=(0, 3))
    joined = rig.joined()
    parts = [rig.data("here") / name for name in ("killed_left", "killed_left_2")]
    check_joined(rig, joined, rig.data("here") / "killed", parts)


def test_a_recorder_that_is_killed_finds_its_parts_again(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    rig.ask("record", "start", "--name", "killed")
    time.sleep(3)
    rig.kill("here")
    time.sleep(1)
    assert rig.status("there")["recording"]["active"]
    rig.start("here")
    rig.wait_for_host("connected")
    wait_for("the other one is stopped", lambda: not rig.status("there")["recording"]["active"])
    joined = rig.joined()
    check_joined(rig, joined, rig.data("here") / "killed", [rig.data("here") / "killed_left"])


def test_kills_at_any_moment_lose_nothing_that_was_recorded(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    random = Random(23)
    for number in range(50 if "DEPTHRIG_LONG" in os.environ else 3):
        name = f"kill{number}"
        rig.ask("record", "start", "--name", name, codes=(0, 3))
        time.sleep(random.uniform(0.0, 2.0))
        victim = random.choice(["here", "there"])
        rig.kill(victim)
        time.sleep(random.uniform(0.0, 1.0))
        rig.start(victim)
        if victim == "there":
            wait_for("a part", lambda: rig.host()["recording"])
            time.sleep(random.uniform(0.3, 1.0))
            rig.ask("record", "stop", codes=(0, 3))
        else:
            rig.wait_for_host("connected")
        joined = rig.joined()
        assert joined.name == f"{name}_joined"
        parts = [rig.data("here") / part["name"] for part in rig.session()["parts"]]
        check_joined(rig, joined, rig.data("here") / name, parts)
        print(f"{name}: {victim}, {len(parts)} parts")


def test_a_host_that_comes_late_gets_its_part_then(rig: Rig) -> None:
    rig.start("here")
    said = rig.ask("record", "start", "--name", "late", codes=(3,))
    assert "host left:" in said
    time.sleep(2)
    rig.start("there")
    wait_for("its part", lambda: rig.host()["recording"] == "late_left")
    time.sleep(3)
    rig.ask("record", "stop", codes=(0, 3))
    check_joined(rig, rig.joined(), rig.data("here") / "late", [rig.data("here") / "late_left"])


def test_a_full_disk_of_the_recorder_delays_the_copy_and_loses_nothing(rig: Rig) -> None:
    disk = rig.data("here")
    disk.mkdir()
    small = f'mount -t tmpfs -o size=256m small "{disk}" && exec "$@"'
    rig.start("here", ["unshare", "-m", "sh", "-c", small, "sh"])
    rig.start("there")
    # What only the daemon sees.
    seen = Path(f"/proc/{rig.daemons['here'].pid}/root{disk}")
    room = os.statvfs(seen)
    assert room.f_blocks * room.f_frsize == 256 << 20
    rig.ask("record", "start", "--name", "full")
    free = room.f_bavail * room.f_frsize
    # Of 64 MB that stay free for recordings, enough for this one.
    (seen / "other").write_bytes(bytes(free - 66_000_000))
    time.sleep(3)

    def part() -> dict[str, Any]:
        (part,) = rig.session()["parts"]
        return part

    why = wait_for("the reason", lambda: part()["why"], 10)
    assert "MB free, which recordings of this computer need" in str(why)
    assert f"{why}"[:40] in rig.ask("status", codes=(0, 3))
    assert rig.status()["recording"]["active"] and rig.status("there")["recording"]["active"]
    rig.ask("record", "stop", codes=(0, 3))
    time.sleep(1)
    assert not part()["is_complete"]
    (seen / "other").unlink()
    wait_for("the part", lambda: part()["is_complete"])
    # It would leave too little to record with, so that it is left to whoever makes room.
    wait_for("word of it", lambda: rig.session()["joined"] == "failed")
    assert "are needed to join the parts and to record after that; make room, then call depthrig merge --hosts" in rig.session()["why"]
    shutil.copytree(seen, disk, dirs_exist_ok=True)
    # Where there is too little room from the first, or the disk takes no more files at any point of joining, nothing is left but the parts.
    small = rig.folder / "small"
    small.mkdir()
    merge = f"""
        {rig.binary} merge --hosts {small}/full_joined {small}/full 2>&1; code=$?
        ls -A {small}
        exit $code"""
    prepare = f"mount -t tmpfs -o %s small {small} && cp -a {disk}/full {disk}/full_left {small} || exit 9\n"

    def merged(script: str) -> str:
        return rig.hosts.run("here", "unshare", "-m", "sh", "-c", script, codes=(0, 1), DEPTHRIG_RUNTIME_DIR=str(rig.runtime["here"]))

    said = merged(prepare % "size=600m" + merge)
    assert "are needed to join the parts" in said and said.split()[-2:] == ["full", "full_left"], said
    files = 1 + sum(1 + len(list((disk / name).iterdir())) for name in ("full", "full_left"))
    for more in range(1, 12):
        said = merged(prepare % f"size=3g,nr_inodes={files + more}" + merge)
        if "full_joined: " in said and " sets of 2 computers" in said:
            break
        assert "No space left on device" in said and said.split()[-2:] == ["full", "full_left"], (more, said)
    assert 3 < more < 11, more
    joined = disk / "full_joined"
    rig.ask("merge", "--hosts", str(joined), str(disk / "full"))
    check_joined(rig, joined, disk / "full", [disk / "full_left"])


def test_a_copy_that_was_damaged_is_pulled_again(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    rig.ask("record", "start", "--name", "damaged")
    pulling = rig.data("here") / ".pulling" / "damaged_left"

    def damaged() -> str | None:
        """The name of a segment that is on its way, whose copy so far was damaged."""
        for copy in pulling.glob("seg_*.mcap.part"):
            try:
                with copy.open("r+b") as file:
                    if file.seek(0, os.SEEK_END) < 10_000:
                        continue
                    file.seek(5_000)
                    file.write(b"damage")
            except FileNotFoundError:  # it was whole meanwhile
                continue
            return copy.stem
        return None

    wait_for("sets", lambda: rig.status()["recording"]["sets"] > 2)
    segment = wait_for("a copy", damaged)
    rig.ask("record", "stop", codes=(0, 3))
    joined = rig.joined()
    assert f"{segment} of damaged_left differs from its copy here" in rig.log("here")
    check_joined(rig, joined, rig.data("here") / "damaged", [rig.data("here") / "damaged_left"])


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        ('rig = "mount"', 'rig = "mount2"', "not connected"),
        ('host = "left"', 'host = "third"', 'write host = "left" into [link]'),
        ('host = "left"', 'host = "left"\ninsecure = true', "only one of both has insecure = true"),
        ('name = "lingbot_3"', 'name = "lingbot_0"', 'camera "lingbot_0" is a name on this computer, too'),
    ],
)
def test_a_computer_that_cannot_be_part_of_the_rig_is_named_and_left_alone(
    rig: Rig, before: str, after: str, why: str
) -> None:
    text = rig.rig_file("there").read_text()
    assert before in text
    rig.rig_file("there").write_text(text.replace(before, after))
    rig.start("here")
    rig.daemons["there"] = rig.hosts.start(
        "there", rig.folder / "there.log", rig.binary, "run", str(rig.rig_file("there")),
        DEPTHRIG_RUNTIME_DIR=str(rig.runtime["there"]), DEPTHRIG_TEST_DATA=str(DATA),
    )  # fmt: skip
    if "not connected" in why:
        time.sleep(3)
    else:
        rig.wait_for_host("refused")
        assert why in rig.host()["why"]
    said = rig.ask("record", "start", "--name", "alone", codes=(3,))
    assert "host left:" in said
    rig.ask("record", "stop", codes=(0, 3))
    assert rig.session()["parts"] == []
    assert not rig.data("there").exists() or not any(rig.data("there").iterdir())


def test_a_computer_that_records_something_else_is_named_at_once(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    rig.ask("record", "start", "--name", "own", host="there")
    said = rig.ask("record", "start", "--name", "mount", codes=(3,))
    assert "host left: it records own, which is no part of this recording" in said
    rig.ask("record", "stop", codes=(0, 3))
    rig.ask("record", "stop", host="there", codes=(0, 3))
    assert rig.session()["parts"] == []


def test_a_part_ends_and_begins_with_the_recording_while_a_slow_wire_pulls(binary: str, tmp_path: Path) -> None:  # noqa: F811
    with two_computers(binary, tmp_path, "10mbit") as rig:
        rig.start("here")
        rig.start("there")
        wait_for("the clock", lambda: rig.host()["has_clock"])
        begins, ends = [], []
        for name in ("first", "second", "third"):
            rig.ask("record", "start", "--name", name)
            time.sleep(5)
            rig.ask("record", "stop", codes=(0, 3))
            here, there = ([v.tick_ns for topic, v, _ in messages(rig.data(host) / folder) if topic == "/mount/frame_set"]
                           for host, folder in (("here", name), ("there", f"{name}_left")))  # fmt: skip
            # Its rest is on the way when the next one begins.
            assert not rig.session()["parts"][0]["is_complete"]
            begins.append((there[0] - SHIFT_NS - here[0]) / 1e9)
            ends.append((there[-1] - SHIFT_NS - here[-1]) / 1e9)
        # Nothing is pulled while the first one begins, and a busy computer is late once.
        assert min(map(abs, begins[1:])) < 1 and min(map(abs, ends)) < 1, (begins, ends)
