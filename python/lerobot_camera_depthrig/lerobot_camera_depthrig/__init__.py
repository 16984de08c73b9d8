"""Cameras of a running depthrig rig for LeRobot, as camera type `depthrig`."""

from .config_depthrig import DepthrigCameraConfig
from .depthrig_camera import DepthrigCamera

__all__ = ["DepthrigCamera", "DepthrigCameraConfig"]
