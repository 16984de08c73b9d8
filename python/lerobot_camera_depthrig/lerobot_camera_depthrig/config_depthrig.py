"""Configuration of a camera of a depthrig rig."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.cameras.configs import CameraConfig, ColorMode


@CameraConfig.register_subclass("depthrig")
@dataclass(kw_only=True)
class DepthrigCameraConfig(CameraConfig):
    """A camera of a running rig; `fps`, `width` and `height` are checked against it."""

    camera: str
    """Name of the camera in the rig file."""
    use_rgb: bool = True
    """Whether to read colour."""
    use_depth: bool = False
    """Whether to read depth."""
    color_stream: str = "color"
    """Colour stream of the camera."""
    depth_stream: str = "depth"
    """Depth stream of the camera; `depth_refined` is refined depth."""
    color_mode: ColorMode = ColorMode.RGB
    """Order of the channels."""
    rig: str | None = None
    """Name of the rig; the only one that runs without it."""
    runtime_dir: str | None = None
    """The rig's runtime folder; this user's without it."""
    timeout_s: float = 5.0
    """Seconds that `connect()` waits for the rig and its first images."""

    def __post_init__(self) -> None:
        self.color_mode = ColorMode(self.color_mode)
        if not self.use_rgb and not self.use_depth:
            raise ValueError(f"camera {self.camera!r}: use_rgb and use_depth are both false; nothing is left to read")
        if not self.camera or "/" in self.camera:
            raise ValueError(
                f"invalid camera name {self.camera!r}: write the camera's name in the rig file; its streams are named by "
                "color_stream and depth_stream"
            )
