#!/usr/bin/env python3
"""Takes out of the package `example-robot-data` the robots that robot_views.py does not draw: 0.4 GB.

ENVIRONMENT/bin/python tests/python/robots_only.py
"""

from __future__ import annotations

import shutil
import sysconfig
from pathlib import Path

KEPT = ("ur_description", "panda_description")


def main() -> None:
    robots = Path(sysconfig.get_path("purelib")) / "cmeel.prefix/share/example-robot-data/robots"
    for robot in robots.iterdir():
        if robot.name not in KEPT:
            shutil.rmtree(robot)


if __name__ == "__main__":
    main()
