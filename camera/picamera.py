"""The Raspberry Pi's camera through picamera2, which this file alone imports, and only when one is asked for."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera.capture import Frame
from camera.markers import Image

# 5 ms: at 1 m/s a marker moves 5 mm. Fixed, because automatic exposure lengthens it in the dark until all is blur.
EXPOSURE_US = 5000
GAIN = 4.0


class PiCamera:
    """A Device of `camera.capture`. Raises OSError if picamera2 or the camera is missing."""

    def __init__(self, width_px: int = 0, height_px: int = 0, frame_rate_hz: float = 0.0) -> None:
        try:
            from picamera2 import Picamera2
        except ImportError as error:
            raise OSError(
                f"camera picamera: picamera2 cannot be imported ({error}). On a Raspberry Pi: `sudo apt install "
                "python3-picamera2 --no-install-recommends`, and make the virtual environment with "
                "--system-site-packages. On other machines use a USB camera (source = 0)"
            ) from None
        self._size = (width_px or 1280, height_px or 960)
        try:
            self._camera: Any = Picamera2()
            controls = {"AeEnable": False, "ExposureTime": EXPOSURE_US, "AnalogueGain": GAIN}
            if frame_rate_hz:
                controls["FrameRate"] = frame_rate_hz
            if "LensPosition" in self._camera.camera_controls:
                # Locked at infinity: a lens that hunts changes the calibration.
                controls |= {"AfMode": 0, "LensPosition": 0.0}
            configuration = self._camera.create_video_configuration(
                main={"format": "YUV420", "size": self._size}, buffer_count=4, queue=False, controls=controls
            )
            self._camera.configure(configuration)
            self._camera.start()
        except (RuntimeError, IndexError) as error:
            raise OSError(
                f"camera picamera: cannot be started ({error}); is it connected, and in use elsewhere?"
            ) from None

    def grab(self) -> Frame:
        """Mid-exposure of the first row, and the grey values. Raises OSError when the camera is lost.

        The other rows follow at the sensor's line time; that of the middle row is a constant which the configuration's
        `time_offset` takes.
        """
        try:
            request = self._camera.capture_request()
        except RuntimeError as error:
            raise OSError(f"camera picamera: lost ({error})") from None
        try:
            metadata = request.get_metadata()
            # Copied before the release: the buffer is the camera's again afterwards.
            image = y_plane(request.make_array("main"), *self._size)
        finally:
            request.release()
        monotonic, boottime = time.monotonic_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        end_of_exposure = host_time(metadata["SensorTimestamp"], monotonic, boottime)
        exposure = 1e-6 * metadata["ExposureTime"]
        return Frame(end_of_exposure - 0.5 * exposure, image, exposure=exposure)

    def close(self) -> None:
        self._camera.stop()
        self._camera.close()


def y_plane(yuv420: NDArray[np.uint8], width_px: int, height_px: int) -> Image:
    """The grey image out of a planar YUV420 buffer (rows, stride): its first `height_px` rows, padding cut off."""
    return np.ascontiguousarray(yuv420[:height_px, :width_px])


def host_time(sensor_timestamp_ns: int, monotonic_ns: int, boottime_ns: int) -> float:
    """A sensor's stamp -> s on the host's monotonic clock, given both of the host's clocks now.

    libcamera documents SensorTimestamp as CLOCK_BOOTTIME, drivers report CLOCK_MONOTONIC: they differ by the time that
    the machine was suspended. A frame is never from the future and rarely older than a second, which tells them apart.
    """
    ages = (monotonic_ns - sensor_timestamp_ns, boottime_ns - sensor_timestamp_ns)
    age = min(age for age in ages if age >= 0) if max(ages) >= 0 else 0
    return 1e-9 * (monotonic_ns - age)
