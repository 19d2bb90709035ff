"""The Raspberry Pi's camera through picamera2, which this file alone imports, and only when one is asked for."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera.capture import Frame
from camera.images import Image
from camera.settings import CAMERAS_OWN, CaptureSettings
from camera.stamp import host_clocks, host_time

# s, where none is asked for: at 1 m/s a marker moves 5 mm. Fixed, because the automatic lengthens it in the dark until
# all is blur.
EXPOSURE = 0.005
GAIN = 4.0
SIZE_PX = (1280, 960)
# s without a frame after which it is lost.
TIMEOUT = 5.0

_log = logging.getLogger(__name__)


class PiCamera:
    """A Device of `camera.capture`, with fixed exposure and gain; where none is asked for, what stands above.

    Raises OSError if picamera2 or the camera is missing.
    """

    def __init__(self, settings: CaptureSettings = CAMERAS_OWN) -> None:
        try:
            from picamera2 import Picamera2
        except ImportError as error:
            raise OSError(
                f"camera picamera: picamera2 cannot be imported ({error}). On a Raspberry Pi: `sudo apt install "
                "python3-picamera2 --no-install-recommends`, and make the virtual environment with "
                "--system-site-packages. On other machines use a USB camera (source = 0)"
            ) from None
        self._clock: str | None = None
        self._asked = settings.exposure or EXPOSURE
        try:
            self._camera: Any = Picamera2()
            controls = {
                "AeEnable": False,
                "ExposureTime": round(1e6 * self._asked),
                "AnalogueGain": settings.gain or GAIN,
            }
            if settings.frame_rate_hz:
                controls["FrameRate"] = settings.frame_rate_hz
            if "LensPosition" in self._camera.camera_controls:
                # Locked at infinity: a lens that hunts changes the calibration.
                controls |= {"AfMode": 0, "LensPosition": 0.0}
            configuration = self._camera.create_video_configuration(
                main={"format": "YUV420", "size": (settings.width_px or SIZE_PX[0], settings.height_px or SIZE_PX[1])},
                buffer_count=4,
                queue=False,
                controls=controls,
            )
            self._camera.configure(configuration)
            # What it has made of the wish.
            self._size: tuple[int, int] = self._camera.camera_configuration()["main"]["size"]
            self._camera.start()
        except (RuntimeError, IndexError) as error:
            raise OSError(
                f"camera picamera: cannot be started ({error}); is it connected, and in use elsewhere?"
            ) from None

    def grab(self) -> Frame:
        """See Device. The other rows follow the first at the sensor's line time."""
        try:
            request = self._camera.capture_request(wait=TIMEOUT)
            try:
                metadata = request.get_metadata()
                # Copied before the release: the buffer is the camera's again afterwards.
                image = y_plane(request.make_array("main"), *self._size)
            finally:
                request.release()
        except TimeoutError:
            raise OSError(f"camera picamera: lost; no frame for {TIMEOUT:g} s") from None
        except RuntimeError as error:
            raise OSError(f"camera picamera: lost ({error})") from None
        clocks = host_clocks()
        exposure = 1e-6 * metadata.get("ExposureTime", math.nan)
        # The sensor's stamp is of the first row's readout, which ends its exposure.
        stamped = host_time(1e-9 * metadata.get("SensorTimestamp", math.nan), clocks)
        t, clock = stamped or (clocks["monotonic"], "")
        if clock != self._clock:
            if self._clock is None and not math.isclose(exposure, self._asked, rel_tol=0.05):
                text = "camera picamera: exposure_ms = %g was asked for, it has %g; the frame rate limits it"
                _log.warning(text, 1e3 * self._asked, 1e3 * exposure)
            self._clock = clock
            how = f"by the sensor, on the {clock} clock" if clock else "on arrival: the sensor's stamp fits no clock"
            _log.info("camera picamera: frames are stamped %s", how)
        return Frame(t - 0.5 * exposure if math.isfinite(exposure) else t, image, exposure=exposure)

    def close(self) -> None:
        self._camera.stop()
        self._camera.close()


def y_plane(yuv420: NDArray[np.uint8], width_px: int, height_px: int) -> Image:
    """The grey image out of a planar YUV420 buffer (rows, stride): its first `height_px` rows, padding cut off."""
    return np.ascontiguousarray(yuv420[:height_px, :width_px])
