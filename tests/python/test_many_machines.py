"""Work that many machines share: parts whose processes are killed, and a bucket of an S3 server that is not ours."""

from __future__ import annotations

import http.server
import json
import os
import random
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from PIL import Image
from test_daemon import WAIT_S, binary, environment, running, runtime  # noqa: F401  (fixtures)

if sys.version_info < (3, 11):
    pytest.skip("depthrig.lab needs Python 3.11", allow_module_level=True)

from depthrig.lab import ray

RIG = """
rig = "lab"
[recording]
segment_max_s = 1
[[camera]]
name = "cam"
backend = "synthetic"
model = "d435"
cheap = true
[[camera.stream]]
name = "depth"
width = 160
height = 120
"""
COLOR = '[[camera.stream]]\nname = "color"\nwidth = 160\nheight = 120\n'
SCENES = ["scenes", "--count", "12", "--per-shard", "2", "--size", "160x120", "--threads", "1"]
KILLS = 6


def record(binary: str, runtime: Path, folder: Path, rig: str) -> Path:
    """Record some seconds, a segment each; returns the dataset."""
    folder.mkdir()
    (folder / "rig.toml").write_text(rig)
    arguments = ("run", str(folder / "rig.toml"), "--record", str(folder / "data"), "--seconds", "5")
    with running(binary, runtime, folder / "log", *arguments) as daemon:
        daemon.wait(WAIT_S)
    (found,) = sorted(p.parent for p in folder.rglob("session.toml"))
    return found


@pytest.fixture(scope="module")
def data(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A folder with a dataset of several segments."""
    return record(binary, runtime, tmp_path_factory.mktemp("lab") / "one", RIG + COLOR).parent


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def code(binary: str, *arguments: str, env: dict[str, str] | None = None) -> tuple[int, str, str]:  # noqa: F811
    run = subprocess.run(
        [binary, *arguments], env=env, capture_output=True, text=True, timeout=WAIT_S * 4, check=False
    )
    return run.returncode, run.stdout, run.stderr


def children(name: str) -> list[int]:
    """Processes of this one whose arguments begin with a program."""
    found = []
    for thread in Path("/proc/self/task").iterdir():
        for pid in (thread / "children").read_text().split():
            try:
                if Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0] == name.encode():
                    found.append(int(pid))
            except OSError:
                pass  # it has ended
    return found


@contextmanager
def killing(program: str, seed: int) -> Iterator[list[int]]:
    """Kill running processes of a program, one of those that are there at a time; yields those that were killed."""
    killed: list[int] = []
    done = threading.Event()
    chance = random.Random(seed)

    def kill() -> None:
        while len(killed) < KILLS and not done.wait(0.02 + 0.1 * chance.random()):
            if there := [p for p in children(program) if p not in killed]:
                pid = chance.choice(there)
                os.kill(pid, 9)
                killed.append(pid)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("what", ["scenes", "relabel"])
def test_killed_workers_lose_and_double_nothing(
    binary: str, data: Path, tmp_path: Path, what: str  # noqa: F811
) -> None:
    command = SCENES if what == "scenes" else ["cdm", "relabel", str(data), "--engine", "fill", "-j", "1"]
    assert code(binary, *command, "--out", str(tmp_path / "calm"))[0] == 0
    out = tmp_path / "disturbed"
    with killing(binary, seed=3) as killed:
        # Every kill may hit the same part.
        ray.run_local([binary, *command, "--out", str(out)], n=3, jobs=2, retries=KILLS)
    assert killed, "the work was over before a worker was killed"
    assert files(out) == files(tmp_path / "calm")


def test_a_command_ends_with_its_worker(tmp_path: Path) -> None:
    script = f"""
import pathlib, sys
from depthrig.lab import ray
ray.run_local([sys.executable, "-c", "import os, pathlib, time; "
    "pathlib.Path({str(tmp_path / "pid")!r} + '.new').write_text(str(os.getpid())); "
    "os.rename({str(tmp_path / "pid")!r} + '.new', {str(tmp_path / "pid")!r}); time.sleep(600)"], 1, 1)
"""
    worker = subprocess.Popen([sys.executable, "-c", script])
    while not (tmp_path / "pid").exists():
        assert worker.poll() is None
        time.sleep(0.02)
    pid = int((tmp_path / "pid").read_text())
    worker.kill()
    worker.wait(WAIT_S)
    began = time.monotonic()
    while Path(f"/proc/{pid}").exists() and "zombie" not in Path(f"/proc/{pid}/status").read_text():
        assert time.monotonic() - began < WAIT_S, "the command outlives its worker"
        time.sleep(0.02)


@contextmanager
def moto() -> Iterator[str]:
    """The address of an S3 server with the bucket `lab`."""
    pytest.importorskip("moto", reason="moto is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    address = f"http://127.0.0.1:{port}"
    try:
        began = time.monotonic()
        while True:
            try:
                urllib.request.urlopen(urllib.request.Request(f"{address}/lab", method="PUT"), timeout=WAIT_S).close()
                break
            except OSError:
                assert server.poll() is None, "moto ended"
                assert time.monotonic() - began < WAIT_S, "moto does not answer"
                time.sleep(0.1)
        yield address
    finally:
        server.kill()
        server.wait()


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with moto() as address:
        yield address


def cloud(address: str, **more: str) -> dict[str, str]:
    """The environment of a command that uses this server."""
    ours = {k: v for k, v in os.environ.items() if not k.startswith("AWS_")}
    keys = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}
    return {**ours, **keys, "AWS_ENDPOINT_URL": address, **more}


def objects(address: str, prefix: str) -> dict[str, bytes]:
    """By a client that is not ours."""
    import boto3

    keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
    client = boto3.client("s3", endpoint_url=address, **keys)
    listed = client.get_paginator("list_objects_v2").paginate(Bucket="lab", Prefix=f"{prefix}/")
    names = [o["Key"] for page in listed for o in page.get("Contents", [])]
    return {n[len(prefix) + 1 :]: client.get_object(Bucket="lab", Key=n)["Body"].read() for n in names}


def upload(address: str, folder: Path, prefix: str) -> None:
    import boto3

    keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
    client = boto3.client("s3", endpoint_url=address, **keys)
    for name, content in files(folder).items():
        client.put_object(Bucket="lab", Key=f"{prefix}/{name}", Body=content)


def test_a_bucket_gets_what_a_folder_gets(binary: str, data: Path, tmp_path: Path, server: str) -> None:  # noqa: F811
    env = cloud(server, TMPDIR=str(tmp_path))
    upload(server, data, "data")
    refine = ["cdm", "relabel", "--engine", "fill"]
    for command, source, remote in [
        (SCENES, [], []),
        (refine, [str(data)], [str(data)]),
        (refine, [str(data)], ["s3://lab/data"]),
    ]:
        name = f"{command[-1]}-{len(list(tmp_path.iterdir()))}"
        here = tmp_path / name
        assert code(binary, *command, *source, "--out", str(here), "--shard", "0/1")[0] == 0
        outs = ["--out", f"s3://lab/{name}", "--json"]
        done = [code(binary, *command, *remote, *outs, "--shard", f"{k}/2", env=env) for k in (0, 1)]
        assert [d[0] for d in done] == [0, 0], done
        assert objects(server, name) == files(here)
        # Again: all of it is there.
        again, said, _ = code(binary, *command, *remote, *outs, "--shard", "0/1", env=env)
        report = json.loads(said)
        assert again == 0
        assert report.get("shards_found", report.get("pieces_found")) == report.get("shards", report.get("pieces"))
        other = ["--seed", "9"] if command is SCENES else ["--fill-reach", "0.5"]
        refused, _, why = code(binary, *command, *other, *remote, *outs, "--shard", "0/1", env=env)
        assert (refused, "other arguments" in why) == (2, True), why
    assert not list(tmp_path.glob("depthrig-*")), "copies are removed"


def test_two_workers_of_one_part_double_nothing(binary: str, tmp_path: Path, server: str) -> None:  # noqa: F811
    """Shards of more than one request, which go in parts."""
    command = ["scenes", "--count", "24", "--per-shard", "24", "--size", "1280x720", "--name", "big"]
    assert code(binary, *command, "--out", str(tmp_path / "here"))[0] == 0
    (shard,) = (tmp_path / "here").glob("*.tar")
    assert shard.stat().st_size > 16 << 20
    with_s3 = [binary, *command, "--out", "s3://lab/twice"]
    both = [subprocess.Popen(with_s3, env=cloud(server), stdout=subprocess.DEVNULL) for _ in range(2)]
    assert [p.wait(WAIT_S * 4) for p in both] == [0, 0]
    assert objects(server, "twice") == files(tmp_path / "here")


def test_errors_of_a_bucket_are_clear(binary: str, data: Path, tmp_path: Path, server: str) -> None:  # noqa: F811
    def fails(out: str, env: dict[str, str]) -> str:
        ended, _, why = code(binary, *SCENES, "--out", out, env=env)
        assert ended == 1, why
        return why

    why = fails("s3://nowhere/x", cloud(server))
    assert "has no bucket nowhere" in why
    ended, _, why = code(binary, *SCENES, "--out", "s3:///x", env=cloud(server))
    assert (ended, "no bucket is named" in why) == (2, True)
    ended, _, why = code(
        binary, "cdm", "relabel", "s3://lab/empty", "--out", str(tmp_path / "x"), "--engine", "fill", env=cloud(server)
    )
    assert (ended, "neither a dataset nor a folder of datasets" in why) == (1, True), why
    # A server that denies.
    with answering(403, b"<Error><Code>AccessDenied</Code></Error>") as (address, _):
        assert "denies access; check AWS_ACCESS_KEY_ID" in fails("s3://lab/x", cloud(address))
    # One that has a bad moment, again and again: a bounded number of tries.
    with answering(503, b"<Error><Code>SlowDown</Code></Error>") as (address, requests):
        fails("s3://lab/x", cloud(address))
        assert 2 <= len(requests) <= 12
    # One that hangs up in the middle of every answer.
    with answering(200, b"half", length=1000) as (address, requests):
        assert "does not answer" in fails("s3://lab/x", cloud(address))
        assert 2 <= len(requests) <= 12
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{closed.getsockname()[1]}"
    assert "does not answer" in fails("s3://lab/x", cloud(address))


@contextmanager
def answering(status: int, body: bytes, length: int | None = None) -> Iterator[tuple[str, list[str]]]:
    """A server that gives one answer; yields its address and the requests."""
    requests: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def answer(self) -> None:
            requests.append(self.command)
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            self.send_response(status)
            self.send_header("Content-Length", str(length or len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)
            self.close_connection = True

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = answer

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}", requests
        finally:
            server.shutdown()


def test_a_connection_lost_in_the_middle_is_asked_again(
    binary: str, data: Path, tmp_path: Path, server: str  # noqa: F811
) -> None:
    upload(server, data, "lossy")
    assert code(binary, "cdm", "relabel", str(data), "--out", str(tmp_path / "here"), "--shard", "0/1")[0] == 0
    with losing(server, every=4) as (address, lost):
        arguments = ["cdm", "relabel", "s3://lab/lossy", "--out", "s3://lab/lossy-out"]
        ended, _, why = code(binary, *arguments, env=cloud(address))
    assert ended == 0, why
    assert lost, "no connection was lost"
    assert objects(server, "lossy-out") == files(tmp_path / "here")


@contextmanager
def losing(server: str, every: int) -> Iterator[tuple[str, list[int]]]:
    """A proxy before a server that ends each n-th connection after some bytes of the answer; yields those it ended."""
    host, port = server.removeprefix("http://").split(":")
    listener = socket.create_server(("127.0.0.1", 0))
    lost: list[int] = []

    def pump(client: socket.socket, number: int) -> None:
        with client, socket.create_connection((host, int(port))) as upstream:

            def forward() -> None:
                try:
                    while more := client.recv(1 << 16):
                        upstream.sendall(more)
                except OSError:
                    pass

            threading.Thread(target=forward, daemon=True).start()
            try:
                while more := upstream.recv(1 << 16):
                    if number % every == every - 1:
                        client.sendall(more[:20])
                        lost.append(number)
                        return
                    client.sendall(more)
            except OSError:
                pass

    def serve() -> None:
        number = 0
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=pump, args=(client, number), daemon=True).start()
            number += 1

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", lost
    finally:
        listener.close()


def relabel(binary: str, source: Path, out: Path, *more: str, part: str = "0/1") -> tuple[int, dict, str]:  # noqa: F811
    """Make the pieces of a part; returns the exit code, the report and what was said."""
    arguments = ["cdm", "relabel", str(source), "--out", str(out), "--engine", "fill", "--json", "--shard", part]
    ended, said, why = code(binary, *arguments, *more)
    return ended, json.loads(said) if said else {}, why


def test_the_parts_make_what_one_run_makes(binary: str, data: Path, tmp_path: Path) -> None:  # noqa: F811
    before = files(data)
    ended, one, why = relabel(binary, data, tmp_path / "one", "-j", "2")
    assert ended == 0, why
    assert one["pieces"] >= 3
    assert one["pieces_found"] == one["pieces_missing"] == one["lost"] == 0
    assert one["frames"] == one["sets"] == one["streams"][0]["frames"]
    assert one["frames_per_core_second"] > 0
    parts = [relabel(binary, data, tmp_path / "three", "-j", "1", part=f"{k}/3") for k in range(3)]
    assert [p[0] for p in parts] == [0, 0, 0]
    assert files(tmp_path / "three") == files(tmp_path / "one")
    assert files(data) == before, "the source is only read"
    for key in ("pieces", "sets", "bytes", "frames"):
        assert one[key] == sum(p[1][key] for p in parts), key
    for key in ("frames", "pixels", "holes_before", "holes", "unpaired"):
        assert one["streams"][0][key] == sum(p[1]["streams"][0][key] for p in parts), key
    assert one["streams"][0]["holes"] < one["streams"][0]["holes_before"] < one["streams"][0]["pixels"]
    _, again, _ = relabel(binary, data, tmp_path / "one")
    assert (again["pieces_found"], again["frames"]) == (one["pieces"], 0)
    assert {k: again[k] for k in ("sets", "bytes", "streams")} == {k: one[k] for k in ("sets", "bytes", "streams")}
    # Each piece is a dataset; joined they are what a run without parts makes.
    pieces = sorted(p for p in (tmp_path / "one").iterdir() if p.is_dir())
    for piece in pieces:
        assert code(binary, "verify", "--decode", str(piece))[0] == 0
    (dataset,) = data.iterdir()
    whole, joined = str(tmp_path / "whole"), str(tmp_path / "joined")
    assert code(binary, "cdm", "relabel", str(dataset), whole, "--engine", "fill")[0] == 0
    assert code(binary, "merge", joined, *map(str, pieces))[0] == 0
    ended, said, why = code(binary, "verify", joined)
    assert ended == 0, said + why
    ended, said, why = code(binary, "compare", joined, whole)
    assert ended == 0, said + why
    exported = code(binary, "export", "bytecameradepth", str(pieces[0]), str(tmp_path / "exported"))
    assert exported[0] in (0, 3), exported[2]


def test_what_is_there_of_another_run_is_left_alone(
    binary: str, runtime: Path, data: Path, tmp_path: Path  # noqa: F811
) -> None:
    (dataset,) = data.iterdir()
    source = tmp_path / "source"
    subprocess.run(["cp", "-r", str(dataset), str(source)], check=True)
    out = tmp_path / "out"
    for part in ("1/1", "3/2", "0/0"):
        assert relabel(binary, source, out, part=part)[0] == 2
    assert relabel(binary, tmp_path / "nothing", out)[0] == 1
    assert relabel(binary, source, source / "inner")[0] == 2
    assert not out.exists()
    assert relabel(binary, source, out)[0] == 0
    before = files(out)
    ended, _, why = relabel(binary, source, out, "--fill-reach", "0.5")
    assert (ended, "other arguments" in why) == (2, True), why
    assert code(binary, "edit", str(source), "--scene", "another")[0] == 0
    ended, _, why = relabel(binary, source, out)
    assert (ended, "another state of source/seg_0000.mcap" in why) == (2, True), why
    (tmp_path / "other" / "source_0000").mkdir(parents=True)
    ended, _, why = relabel(binary, source, tmp_path / "other")
    assert (ended, "is not a piece" in why) == (2, True), why
    assert files(out) == before


def test_what_cannot_be_refined_is_skipped_and_named(
    binary: str, runtime: Path, data: Path, tmp_path: Path  # noqa: F811
) -> None:
    (dataset,) = data.iterdir()
    folder = tmp_path / "data"
    folder.mkdir()
    for name in ("good", "torn", "empty"):
        subprocess.run(["cp", "-r", str(dataset), str(folder / name)], check=True)
    for name, keep in (("torn", 2), ("empty", 1000)):
        segment = folder / name / "seg_0001.mcap"
        os.truncate(segment, segment.stat().st_size // keep)
    (folder / "odd").mkdir()
    (folder / "odd" / "session.toml").write_text("streams = 7")
    (folder / "notes").mkdir()
    grey = record(binary, runtime, tmp_path / "grey", RIG)
    grey.rename(folder / "grey")
    (tmp_path / "images").mkdir()
    for kind, mode in (("color", "RGB"), ("depth", "I;16")):
        Image.new(mode, (32, 24), 700 if kind == "depth" else (9, 9, 9)).save(tmp_path / "images" / f"{kind}_1.png")
    manifest = 'model = "M"\nrate_hz = 10.0\n[[stream]]\nname = "color"\nfiles = "color_*.png"\n'
    manifest += '[[stream]]\nname = "depth"\nfiles = "depth_*.png"\ndepth_unit_m = 0.001\n'
    (tmp_path / "images" / "camera.toml").write_text(manifest)
    rig = 'rig = "lab"\n[[camera]]\nname = "cam"\nbackend = "files"\nmanifest = '
    plain = record(binary, runtime, tmp_path / "plain", rig + json.dumps(str(tmp_path / "images")))
    plain.rename(folder / "plain")
    (tmp_path / "live.toml").write_text(RIG + COLOR)
    arguments = ("run", str(tmp_path / "live.toml"), "--record", str(tmp_path / "live"))
    with running(binary, runtime, tmp_path / "log", *arguments):
        began = time.monotonic()
        while not (live := [p.parent for p in (tmp_path / "live").rglob("session.toml")]):
            assert time.monotonic() - began < WAIT_S, "nothing is recorded"
            time.sleep(0.05)
        (folder / "live").symlink_to(live[0])
        ended, report, why = relabel(binary, folder, tmp_path / "out")
    assert ended == 3, why
    skipped = {s["dataset"]: s["why"] for s in report["skipped"]}
    assert skipped.keys() == {"empty", "grey", "live", "odd", "plain"}, skipped
    assert "cut before its first set" in skipped["empty"]
    assert "has both color and depth" in skipped["grey"]
    assert "is being recorded" in skipped["live"]
    assert "session.toml" in skipped["odd"]
    assert "has a calibration" in skipped["plain"]
    assert all(f"skipped: {name}" in why for name in skipped)
    # Of half a segment what is there is refined, and the loss is stated, by the next run too.
    assert report["lost"] > 0
    assert any("seg_0001.mcap" in p for p in report["problems"]), report["problems"]
    (folder / "live").unlink()
    ended, again, _ = relabel(binary, folder, tmp_path / "out")
    assert (ended, again["lost"], again["frames"]) == (3, report["lost"], 0)
    skips = [len(relabel(binary, folder, tmp_path / "parts", part=f"{k}/3")[1]["skipped"]) for k in range(3)]
    assert sum(skips) == len(again["skipped"]), "each is counted by one part"


def test_no_room_ends_a_run_and_the_next_one_makes_the_rest(binary: str, data: Path, tmp_path: Path) -> None:  # noqa: F811
    assert relabel(binary, data, tmp_path / "roomy")[0] == 0
    largest = max(len(content) for content in files(tmp_path / "roomy").values())
    limited = ["prlimit", f"--fsize={largest // 2}", binary]
    arguments = ["cdm", "relabel", str(data), "--out", str(tmp_path / "out"), "--engine", "fill", "--shard", "0/1"]
    done = subprocess.run([*limited, *arguments], capture_output=True, text=True, timeout=WAIT_S * 4, check=False)
    assert (done.returncode, "ulimit -f" in done.stderr) == (1, True), done.stderr
    assert not list((tmp_path / "out").glob("*/account.json"))
    assert relabel(binary, data, tmp_path / "out")[0] == 0
    assert files(tmp_path / "out") == files(tmp_path / "roomy")
