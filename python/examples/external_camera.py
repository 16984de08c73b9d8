"""Serve a camera of your own to a rig: here a moving pattern where yours has an SDK.

In the rig file:

    [[camera]]
    name = "front"
    backend = "external"
    command = ["python3", "external_camera.py"]

or without `command`, started by hand: python external_camera.py --camera front
"""

from __future__ import annotations

import argparse
import signal
import time

import numpy as np

import depthrig

WIDTH, HEIGHT, RATE_HZ = 640, 480, 30.0


def main() -> None:
    """Serve sessions, and frames for as long as they are wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--camera", help="camera name in the rig file [default: set by the daemon]")
    parser.add_argument("--rig", help="rig name [default: set by the daemon, else the only one running]")
    options = parser.parse_args()

    # The first mode of a stream is its default; here the frames are stamped by this computer's clock.
    lens = depthrig.Intrinsics(600.0, 600.0, WIDTH / 2, HEIGHT / 2, (0.0,) * 8, int(depthrig.Distortion.NONE), 0)
    common = {"intrinsics": lens, "clock": depthrig.ExternalClock.HOST, "simulated": True}
    modes = [
        depthrig.ExternalMode("color", depthrig.PixelFormat.RGB8, WIDTH, HEIGHT, RATE_HZ, **common),
        depthrig.ExternalMode("depth", depthrig.PixelFormat.Z16, WIDTH, HEIGHT, RATE_HZ, depth_unit_m=0.001, **common),
    ]
    with depthrig.ExternalCamera(options.camera, modes, model="Pattern", serial="1", rig=options.rig) as camera:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: camera.stop())
        for session in camera.sessions():
            print(f"session {session.number}: {', '.join(map(str, session.streams.values()))}", flush=True)
            play(session)


def play(session: depthrig.ExternalSession) -> None:
    """Start the camera, send its frames, stop it: here they are drawn."""
    ramp = np.add.outer(np.arange(HEIGHT), np.arange(WIDTH))
    due = time.monotonic()
    number = 0
    while session.wanted:
        due = max(due + 1 / RATE_HZ, time.monotonic())  # delays are not made up by a burst
        time.sleep(max(0.0, due - time.monotonic()))
        number += 1
        facts = {"device_time": time.monotonic_ns(), "device_sequence": number}
        if "depth" in session.streams:
            session.send("depth", (1000 + (ramp + number) % 1000).astype(np.uint16), **facts)
        # Drawn where the daemon reads it: not copied at all.
        lent = session.lend("color") if "color" in session.streams else None
        if lent is not None:
            for channel in range(3):
                lent.array[..., channel] = (ramp + (channel + 1) * number).astype(np.uint8)
            lent.send(**facts)


if __name__ == "__main__":
    main()
