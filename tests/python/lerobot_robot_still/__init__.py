"""A robot and a teleoperator of two joints that stand still, with cameras, for LeRobot's recorder.

LeRobot's own mock robot is among its tests, which its wheel lacks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = {"shoulder.pos": float, "elbow.pos": float}
STILL = {"shoulder.pos": 0.25, "elbow.pos": -0.5}


class Still:
    is_connected = False
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass


@RobotConfig.register_subclass("still")
@dataclass
class StillRobotConfig(RobotConfig):
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class StillRobot(Still, Robot):
    config_class = StillRobotConfig
    name = "still"

    def __init__(self, config: StillRobotConfig) -> None:
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)

    @property
    def observation_features(self) -> dict:
        shapes: dict[str, Any] = dict(JOINTS)
        for name, camera in self.cameras.items():
            if getattr(camera, "use_rgb", True):
                shapes[name] = (camera.height, camera.width, 3)
            if getattr(camera, "use_depth", False):
                shapes[f"{name}_depth"] = (camera.height, camera.width, 1)
        return shapes

    action_features = JOINTS

    def connect(self, calibrate: bool = True) -> None:
        for camera in self.cameras.values():
            camera.connect()
        self.is_connected = True

    def disconnect(self) -> None:
        for camera in self.cameras.values():
            camera.disconnect()
        self.is_connected = False

    def get_observation(self) -> dict:
        """In the order of LeRobot's own robots."""
        seen: dict[str, Any] = dict(STILL)
        for name, camera in self.cameras.items():
            if getattr(camera, "use_rgb", True):
                seen[name] = camera.read_latest(60_000)
            if getattr(camera, "use_depth", False):
                seen[f"{name}_depth"] = camera.read_latest_depth(60_000)
        return seen

    def send_action(self, action: dict) -> dict:
        return action


@TeleoperatorConfig.register_subclass("still")
@dataclass
class StillTeleopConfig(TeleoperatorConfig):
    pass


class StillTeleop(Still, Teleoperator):
    config_class = StillTeleopConfig
    name = "still"
    action_features = JOINTS
    feedback_features: dict = {}

    def get_action(self) -> dict:
        return dict(STILL)

    def send_feedback(self, feedback: dict) -> None:
        pass
