"""The tests of `depthrig.lab`: each module skips itself where the extra is not installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

# One thread: sums have one order, and other tests run beside these.
os.environ.setdefault("OMP_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "python" / "tests"))

from limits import *  # noqa: F403
