"""Work that many machines share: parts whose processes are killed, and a bucket of an S3 server that is not ours."""

from __future__ import annotations

import http.client
import http.server
import itertools
import json
import os
import random
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
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
FILES = 'rig = "lab"\n[[camera]]\nname = "cam"\nbackend = "files"\nmanifest = '
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


@pytest.fixture(scope="module")
def noisy(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A folder with a dataset whose segment has more bytes than go in one request."""
    folder = tmp_path_factory.mktemp("noisy")
    images(folder, np.random.default_rng(1).integers(400, 4000, (480, 640), np.uint16))
    return record(binary, runtime, folder / "one", FILES + json.dumps(str(folder))).parent


def images(folder: Path, depth: np.ndarray) -> None:
    """Write a camera without calibration that has a pair of images."""
    color = np.stack([depth, depth >> 3, depth >> 5], axis=2).astype(np.uint8)
    Image.fromarray(color).save(folder / "color_1.png")
    Image.fromarray(depth).save(folder / "depth_1.png")
    manifest = 'model = "M"\nrate_hz = 10.0\n[[stream]]\nname = "color"\nfiles = "color_*.png"\n'
    manifest += '[[stream]]\nname = "depth"\nfiles = "depth_*.png"\ndepth_unit_m = 0.001\n'
    (folder / "camera.toml").write_text(manifest)


def files(folder: Path) -> dict[str, bytes]:
    """All files but the hidden ones, of which a killed process may leave one; folders have no content."""
    there = [p for p in sorted(folder.rglob("*")) if not p.name.startswith(".")]
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in there}


def contents(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in files(folder).items() if (folder / name).is_file()}


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
                with suppress(ProcessLookupError):  # it has ended
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
    assert code(binary, *command, "--out", str(tmp_path / "calm"), "--shard", "0/1")[0] == 0
    # A busy computer may start to kill when the work is over.
    for out in (tmp_path / f"disturbed_{i}" for i in range(5)):
        with killing(binary, seed=3) as killed:
            # Every kill may hit the same part.
            ray.run_local([binary, *command, "--out", str(out)], n=3, jobs=2, retries=KILLS)
        if killed:
            break
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
    with suppress(OSError):  # it has ended
        while "zombie" not in Path(f"/proc/{pid}/status").read_text():
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
    for name in (p.relative_to(folder) for p in folder.rglob("*") if p.is_file()):
        content = (folder / name).read_bytes()
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
        assert objects(server, name) == contents(here)
        # Again: all of it is there.
        again, said, _ = code(binary, *command, *remote, *outs, "--shard", "0/1", env=env)
        report = json.loads(said)
        assert again == 0
        assert report.get("shards_found", report.get("pieces_found")) == report.get("shards", report.get("pieces"))
        other = ["--seed", "9"] if command is SCENES else ["--fill-reach", "0.5"]
        refused, _, why = code(binary, *command, *other, *remote, *outs, "--shard", "0/1", env=env)
        assert (refused, "other arguments" in why) == (2, True), why
    assert not list(tmp_path.glob("depthrig-*")), "copies are removed"


def test_eval_reads_a_bucket_as_a_folder(binary: str, tmp_path: Path, server: str) -> None:  # noqa: F811
    env = cloud(server, TMPDIR=str(tmp_path))
    here = {"shards": tmp_path / "shards", "dataset": tmp_path / "dataset"}
    make = ["--count", "6", "--size", "160x120", "--camera", "d435"]
    assert code(binary, "scenes", *make, "--per-shard", "2", "--out", str(here["shards"]))[0] == 0
    assert code(binary, "scenes", *make, "--dataset", str(here["dataset"]))[0] == 0
    evaluate = ["eval", "--refine", "fill", "-q"]
    for name, folder in here.items():
        upload(server, folder, f"eval/{name}")
        expected, found = (
            code(binary, *evaluate, "--json", source, env=env) for source in (str(folder), f"s3://lab/eval/{name}")
        )
        assert (expected[0], found[0]) == (0, 0), (expected, found)
        local, remote = json.loads(expected[1]), json.loads(found[1])
        assert remote["rows"] == local["rows"] and len(local["rows"]) >= 2
    # Each part copies what it reads; merged, they are the whole.
    sums = [str(tmp_path / f"part{k}") for k in (0, 1)]
    for k, path in enumerate(sums):
        ended = code(binary, *evaluate, "s3://lab/eval/shards", "--shard", f"{k}/2", "--sums", path, env=env)
        assert ended[0] == 0, ended
    whole = json.loads(code(binary, *evaluate, "--json", str(here["shards"]))[1])
    assert json.loads(code(binary, "eval", "--json", "--merge", *sums)[1])["rows"] == whole["rows"]
    assert not list(tmp_path.glob("depthrig-*")), "copies are removed"
    ended, _, why = code(binary, *evaluate, "s3://lab/eval", env=env)
    assert (ended, "no object is there; name the prefix of shards or of one dataset" in why) == (1, True), why


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
    with answering(301, b"") as (address, _):
        assert "is in another region; correct AWS_REGION" in fails("s3://lab/x", cloud(address))
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


def test_an_answer_lost_in_the_middle_is_asked_for_again(
    binary: str, data: Path, tmp_path: Path, server: str  # noqa: F811
) -> None:
    upload(server, data, "lossy")
    arguments = ["cdm", "relabel", "--engine", "fill", "--shard", "0/1", "--out"]
    assert code(binary, *arguments, str(tmp_path / "here"), str(data))[0] == 0
    count = itertools.count(1)
    with proxy(server, lambda *_: "" if next(count) % 4 else "lose") as (address, lost):
        ended, _, why = code(binary, *arguments, "s3://lab/lossy-out", "s3://lab/lossy", env=cloud(address))
    assert ended == 0, why
    assert {request.split()[0] for request in lost} >= {"GET", "PUT"}, lost
    assert objects(server, "lossy-out") == contents(tmp_path / "here")


def test_large_segments_go_in_parts_and_are_there_once(
    binary: str, noisy: Path, tmp_path: Path, server: str  # noqa: F811
) -> None:
    upload(server, noisy, "noisy")
    arguments = ["cdm", "relabel", "--engine", "fill", "--is-aligned", "--shard", "0/1"]
    ended, _, why = code(binary, *arguments, str(noisy), "--out", str(tmp_path / "here"))
    assert ended == 0, why
    want = contents(tmp_path / "here")
    assert max(map(len, want.values())) > 16 << 20
    # Two that do the same work at once.
    command = [binary, *arguments, "s3://lab/noisy", "--out", "s3://lab/twice"]
    both = [subprocess.Popen(command, env=cloud(server), stdout=subprocess.DEVNULL) for _ in range(2)]
    assert [p.wait(WAIT_S * 4) for p in both] == [0, 0]
    assert objects(server, "twice") == want
    # The upload is complete, and the answer that says so is lost: the server knows of no such upload any more.
    seen: list[str] = []

    def lose(method: str, path: str) -> str:
        is_end = method == "POST" and "uploadId=" in path
        seen.extend([path] if is_end else [])
        return "lose" if is_end and len(seen) == 1 else ""

    with proxy(server, lose) as (address, lost):
        ended, _, why = code(binary, *arguments, str(noisy), "--out", "s3://lab/ends", env=cloud(address))
    assert ended == 0, why
    assert len(lost) == 1 and len(seen) >= 2, seen
    assert objects(server, "ends") == want
    # A part is lost for good: the next run makes the rest.
    with proxy(server, lambda _, path: "lose" if "partNumber=2" in path else "") as (address, _):
        ended, _, why = code(binary, *arguments, str(noisy), "--out", "s3://lab/torn", env=cloud(address))
    assert (ended, "does not answer" in why) == (1, True), why
    assert not [name for name in objects(server, "torn") if name != "relabel.json"]
    assert code(binary, *arguments, str(noisy), "--out", "s3://lab/torn", env=cloud(server))[0] == 0
    assert objects(server, "torn") == want


def test_what_others_put_is_never_taken_for_ones_own(
    binary: str, data: Path, tmp_path: Path, server: str  # noqa: F811
) -> None:
    arguments = [binary, "cdm", "relabel", "--engine", "fill", "--shard", "0/1", str(data), "--out"]
    # Requests that are in each other's way: nothing is there yet.
    tried: list[str] = []

    def refuse(method: str, path: str) -> str:
        tried.extend([path] if method == "PUT" else [])
        return "409" if method == "PUT" and tried.count(path) == 1 else ""

    assert code(*arguments, str(tmp_path / "here"))[0] == 0
    with proxy(server, refuse) as (address, refused):
        ended, _, why = code(*arguments, "s3://lab/busy", env=cloud(address))
    assert ended == 0, why
    assert refused
    assert objects(server, "busy") == contents(tmp_path / "here")
    (segment, *_) = (name for name in contents(tmp_path / "here") if name.endswith(".mcap"))
    (tmp_path / "odd" / segment).parent.mkdir(parents=True)
    (tmp_path / "odd" / segment).write_bytes(b"of another version")
    upload(server, tmp_path / "odd", "odd")
    ended, _, why = code(*arguments, "s3://lab/odd", env=cloud(server))
    assert (ended, f"s3://lab/odd/{segment} has 18 bytes instead of" in why) == (1, True), why
    assert not [name for name in objects(server, "odd") if name == f"{Path(segment).parent}/account.json"]


@contextmanager
def proxy(server: str, does: Callable[[str, str], str]) -> Iterator[tuple[str, list[str]]]:
    """A proxy before a server, which asks `does(method, path)` what to do: nothing (""), lose the answer of what the server has
    done ("lose"), or answer 409 itself ("409"). Yields its address and the requests that it spoiled."""
    spoiled: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def answer(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            does_now = does(self.command, self.path)
            if does_now:
                spoiled.append(f"{self.command} {self.path}")
            if does_now == "409":
                self.send_response_only(409)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            upstream = http.client.HTTPConnection(server.removeprefix("http://"), timeout=WAIT_S)
            upstream.request(self.command, self.path, body, dict(self.headers.items()))
            answer = upstream.getresponse()
            content = answer.read()
            upstream.close()
            if does_now == "lose":
                self.wfile.write(b"HTTP/1.1 200 OK\r\nCont")
                self.close_connection = True
                return
            self.send_response_only(answer.status)
            for name, value in answer.headers.items():
                if name.lower() not in ("connection", "transfer-encoding"):
                    self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = answer

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listener:
        listener.daemon_threads = True
        threading.Thread(target=listener.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{listener.server_address[1]}", spoiled
        finally:
            listener.shutdown()


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
    assert one["frames"] == one["streams"][0]["frames"] == one["sets"] - one["streams"][0]["unpaired"] > 0
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


def test_what_a_killed_process_left_beside_a_piece_is_removed(binary: str, data: Path, tmp_path: Path) -> None:  # noqa: F811
    assert relabel(binary, data, tmp_path / "out")[0] == 0
    before = files(tmp_path / "out")
    (piece,) = (p for p in (tmp_path / "out").iterdir() if p.name.endswith("_0001"))
    left = piece.with_name(f"{piece.name}.relabel") / "refined"
    left.mkdir(parents=True)
    (left / "sets_00000000.refined").write_bytes(b"old")
    _, again, _ = relabel(binary, data, tmp_path / "out")
    assert again["frames"] == 0
    assert files(tmp_path / "out") == before


def test_two_processes_never_make_the_same_piece(binary: str, data: Path, tmp_path: Path) -> None:  # noqa: F811
    assert relabel(binary, data, tmp_path / "calm")[0] == 0
    command = [binary, "cdm", "relabel", str(data), "--out", str(tmp_path / "out"), "--engine", "fill"]
    command += ["--shard", "0/1", "--json"]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    ended = [(*p.communicate(timeout=WAIT_S * 4), p.returncode) for p in both]
    assert all(code == 0 or (code == 1 and "another process makes this piece" in why) for _, why, code in ended), ended
    made = [json.loads(said)["frames"] for said, _, code in ended if code == 0]
    ended, rest, _ = relabel(binary, data, tmp_path / "out")
    assert ended == 0
    if len(made) == len(both):
        assert sum(made) == rest["streams"][0]["frames"], "each frame is refined once"
    assert files(tmp_path / "out") == files(tmp_path / "calm")


def test_tiny_refines_segments_too(binary: str, data: Path, tmp_path: Path) -> None:  # noqa: F811
    arguments = ["cdm", "relabel", str(data), "--json", "--shard", "0/1", "--engine", "tiny", "--out"]
    ended, said, why = code(binary, *arguments, str(tmp_path / "out"))
    if ended == 2 and "pip install onnxruntime" in why:
        assert "DEPTHRIG_REQUIRE_ONNXRUNTIME" not in os.environ
        pytest.skip("ONNX Runtime is not installed (tools/onnxruntime.sh)")
    assert ended == 0, why
    report = json.loads(said)
    (stream,) = report["streams"]
    assert stream["engine"].startswith("tiny onnxruntime")
    assert stream["frames"] == report["sets"] - stream["unpaired"] > 0
    # Whatever is made at once.
    ended, _, why = code(binary, *arguments, str(tmp_path / "one"), "-j", "1")
    assert ended == 0, why
    assert files(tmp_path / "out") == files(tmp_path / "one")
    # Another engine belongs into another folder.
    ended, _, why = relabel(binary, data, tmp_path / "out")
    assert (ended, "other arguments" in why) == (2, True), why
    for more, cure in (
        (["--model", "cdm-d435"], "runs a file NAME.onnx, not the installed model cdm-d435"),
        (["--model", "gone.onnx"], "gone.onnx: cannot be read"),
        (["--device", "cuda:0"], "tiny runs on the CPU"),
    ):
        ended, _, why = code(binary, *arguments, str(tmp_path / "bad"), *more)
        assert (ended, cure in why) == (2, True), why
        assert not (tmp_path / "bad").exists(), "nothing hinders the corrected command"


def test_sets_of_discarded_episodes_are_refined_too(binary: str, data: Path, tmp_path: Path) -> None:  # noqa: F811
    (dataset,) = data.iterdir()
    source = tmp_path / "source"
    subprocess.run(["cp", "-r", str(dataset), str(source)], check=True)
    with (source / "session.toml").open("a") as session:
        session.write(f"\n[[episodes]]\nnumber = 1\nstart_utc_ns = 0\nend_utc_ns = {1 << 62}\ndiscarded = true\n")
    ended, report, why = relabel(binary, source, tmp_path / "out")
    assert ended == 0, why
    (stream,) = report["streams"]
    assert stream["frames"] == report["sets"] - stream["unpaired"] > 0
    ended, _, why = code(binary, "cdm", "relabel", str(source), str(tmp_path / "copy"), "--engine", "fill")
    assert ended == 0, why


def test_what_cannot_be_refined_is_skipped_and_named(
    binary: str, runtime: Path, data: Path, tmp_path: Path  # noqa: F811
) -> None:
    (dataset,) = data.iterdir()
    folder = tmp_path / "data"
    folder.mkdir()
    for name in ("good", "torn", "empty"):
        subprocess.run(["cp", "-r", str(dataset), str(folder / name)], check=True)
    # A busy computer may record few sets in a segment.
    cut = max(sorted(dataset.glob("seg_*.mcap"))[1:-1], key=lambda segment: segment.stat().st_size)
    for name, keep in (("torn", 2), ("empty", 1000)):
        os.truncate(folder / name / cut.name, cut.stat().st_size // keep)
    (folder / "odd").mkdir()
    (folder / "odd" / "session.toml").write_text("streams = 7")
    (folder / "notes").mkdir()
    grey = record(binary, runtime, tmp_path / "grey", RIG)
    grey.rename(folder / "grey")
    (tmp_path / "images").mkdir()
    images(tmp_path / "images", np.full((24, 32), 700, np.uint16))
    plain = record(binary, runtime, tmp_path / "plain", FILES + json.dumps(str(tmp_path / "images")))
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
    assert any(cut.name in p for p in report["problems"]), report["problems"]
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
