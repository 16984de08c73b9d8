"""Keep the last frames of a stream as one array, as a policy that sees motion takes them.

python frame_stack.py d435/depth [--frames 4] [--count 10]

Each frame stays where the driver wrote it until a newer one pushes it out; they are copied once, into the stack.
"""

from __future__ import annotations

import argparse
from collections import deque

import numpy as np

import depthrig


def main() -> None:
    """Stack frames, oldest first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", help="CAMERA/STREAM, such as d435/depth")
    parser.add_argument("--frames", type=int, default=4, help="frames of a stack; a subscriber may hold 16")
    parser.add_argument("--count", type=int, default=10, help="stacks to make")
    options = parser.parse_args()

    with depthrig.Stream(options.stream) as stream:
        held: deque[depthrig.Frame] = deque(maxlen=options.frames)
        made = 0
        for frame in stream:
            held.append(frame)
            if len(held) < options.frames:
                continue
            stack = np.stack([f.array for f in held])
            first, last = held[0], held[-1]
            span_ms = (last.capture_time_ns - first.capture_time_ns) / 1e6
            which = f"#{first.sequence} to #{last.sequence}"
            print(f"{which}: {stack.shape} {stack.dtype}, {span_ms:.1f} ms, mean {stack.mean():.1f}")
            made += 1
            if made == options.count:
                break


if __name__ == "__main__":
    main()
