"""Starts and stops recordings of a running rig and marks episodes in them, over the daemon's socket."""

from __future__ import annotations

import http.client
import json
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from ._runtime import PathLike, not_running, pick_rig
from ._runtime import runtime_dir as default_runtime_dir
from .errors import RigRefused

_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Episode:
    """A demonstration: a span of a recording."""

    number: int
    """Its number in the recording, from 1."""
    task: str
    start_utc_ns: int
    """Nanoseconds since 1970 UTC, on the time axis of the sets."""
    end_utc_ns: int | None = None
    """None while it runs."""
    outcome: str | None = None
    """`success`, `failure`, or None without a judgement."""
    discarded: bool = False
    """Not to be used; exports leave it out."""


class Recording:
    """The recording of a running rig.

    :param rig: name of the rig; needed when several run.
    :param runtime_dir: the runtime folder, if it is not the user's own.
    :raises RigNotRunning: when the rig does not run.
    :raises AmbiguousRig: when several run and none is named.

    Methods raise RigRefused with what the rig says, and RigNotRunning when it has ended. One object is for one thread.
    """

    def __init__(self, rig: str | None = None, runtime_dir: PathLike | None = None) -> None:
        self._folder = default_runtime_dir(runtime_dir)
        self.rig = pick_rig(self._folder, rig)

    def start(
        self,
        *,
        scene: str = "",
        operator: str = "",
        notes: str = "",
        name: str | None = None,
        directory: PathLike | None = None,
        force: bool = False,
    ) -> Mapping[str, Any]:
        """Start a recording; returns its status, whose `path` is the dataset.

        :param name: of the dataset's folder; without it date, time and scene.
        :param directory: that the dataset is made in; without it the rig's.
        :param force: also when the disk is expected to be full too soon.
        """
        request: dict[str, Any] = {"scene": scene, "operator": operator, "notes": notes, "name": name, "force": force}
        if directory is not None:
            request["directory"] = os.path.abspath(os.fspath(directory))
        return self._post("/v1/record/start", request)

    def stop(self) -> Mapping[str, Any]:
        """End the recording and wait until its files are closed, which takes as long as the disk needs."""
        return self._post("/v1/record/stop", {}, timeout=None)

    def status(self) -> Mapping[str, Any] | None:
        """Return the status of the recording that goes on, or of the last one; None before the first."""
        status: Mapping[str, Any] | None = self._call("GET", "/v1/record", None, _TIMEOUT_S)
        return status

    def note(self, text: str) -> None:
        """Add a note with the time."""
        self._post("/v1/record/note", {"text": text})

    def start_episode(self, task: str = "") -> Episode:
        """Begin an episode."""
        return self._episode({"action": "start", "task": task})

    def stop_episode(self, outcome: str | None = None) -> Episode:
        """End the episode that runs and keep it; `outcome` is `success`, `failure` or None."""
        return self._episode({"action": "stop", "outcome": outcome})

    def discard_episode(self, number: int | None = None) -> Episode:
        """Mark an episode as not to be used: the one that runs, which ends; else the last one, or that of a number."""
        return self._episode({"action": "discard", "number": number})

    def mark_episode(self, outcome: str | None, number: int | None = None) -> Episode:
        """Judge an episode that has ended, the last one without a number, and keep it."""
        return self._episode({"action": "mark", "outcome": outcome, "number": number})

    @contextmanager
    def episode(self, task: str = "") -> Iterator[Episode]:
        """An episode for the length of a `with` block; an exception in it discards it."""
        episode = self.start_episode(task)
        try:
            yield episode
        except BaseException:
            self.discard_episode(episode.number)
            raise
        self.stop_episode()

    def _episode(self, request: dict[str, Any]) -> Episode:
        answer = self._post("/v1/episode", request)
        fields = {name: answer[name] for name in Episode.__dataclass_fields__ if name in answer}
        return Episode(**fields)

    def _post(self, path: str, request: dict[str, Any], timeout: float | None = _TIMEOUT_S) -> Mapping[str, Any]:
        answer: Mapping[str, Any] = self._call("POST", path, json.dumps(request), timeout)
        return answer

    def _call(self, method: str, path: str, body: str | None, timeout: float | None) -> Any:
        connection = _UnixConnection(os.path.join(self._folder, f"{self.rig}.sock"), timeout)
        try:
            connection.request(method, path, body, {"Content-Type": "application/json"})
            answer = connection.getresponse()
            text = answer.read()
        except (OSError, http.client.HTTPException) as e:
            raise not_running(self._folder, self.rig) from e
        finally:
            connection.close()
        said: Any = json.loads(text) if text else None
        if answer.status >= 400:
            error = said["error"]
            raise RigRefused(f"rig {self.rig!r}: {error['message']}", error["kind"])
        return said


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: str, timeout: float | None) -> None:
        super().__init__("localhost", timeout=timeout)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)
