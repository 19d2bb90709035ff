"""How a camera is to be set. In a file of its own, so that who reads a configuration need not load OpenCV."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct


class CaptureSettings(Struct, frozen=True, kw_only=True):
    """Wishes, by their names in a configuration: 0 and "" leave it to the camera."""

    width_px: Annotated[int, Meta(ge=0, le=20000)] = 0
    height_px: Annotated[int, Meta(ge=0, le=20000)] = 0
    frame_rate_hz: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.0
    pixel_format: Annotated[str, Meta(pattern=r"^([A-Za-z0-9]{4})?$")] = ""
    """Of a USB camera, such as MJPG."""
    exposure_ms: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.0
    """The camera's own is fixed for the Pi's and automatic for others."""
    gain: Annotated[float, Meta(ge=0.0, le=10000.0)] = 0.0
    """A factor for the Pi's camera, the driver's own number for others."""
    line_time: Annotated[float, Meta(ge=0.0, le=0.001)] = 0.0
    """s from one row's exposure to the next one's; 0: all together. Only told to whoever reads the frames."""

    @property
    def exposure(self) -> float:
        """s"""
        return 1e-3 * self.exposure_ms


CAMERAS_OWN = CaptureSettings()
