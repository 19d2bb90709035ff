"""Where frames come from: USB and V4L2 cameras, network cameras, video files, folders of images.

A camera is read by a thread of its own that keeps the newest frame only: a reader that is slow skips frames instead of
falling behind. Files are read in order, at their own pace, without skipping.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

# FFmpeg and OpenCV print warnings of their own; what matters of them is said by the errors of this module. FFmpeg's
# level is only read when it starts.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np

from camera.images import Pixels
from camera.settings import CAMERAS_OWN, CaptureSettings
from camera.stamp import StreamClock, host_clocks, host_time

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

IMAGE_SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"))
# Frames per second of a folder of images where the configuration does not say.
FOLDER_RATE_HZ = 10.0
# A network camera that does not answer for so long is lost, s.
NETWORK_TIMEOUT = 5.0
# V4L2_CID_EXPOSURE_ABSOLUTE counts in these, ms.
_EXPOSURE_UNIT_MS = 0.1

_log = logging.getLogger(__name__)
# Two threads that redirect standard error at once would leave it redirected.
_stderr_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture. `t`: s on the host's monotonic clock, mid-exposure of its first row as well as it is known. `image`:
    grey or BGR.

    `sequence` counts what the source delivered, frames that were skipped included. `exposure`: s, nan where it is not
    known. `line_time`: s from one row's exposure to the next one's, 0 where all rows are exposed together.
    """

    t: float
    image: Pixels
    sequence: int = 0
    exposure: float = math.nan
    line_time: float = 0.0


class FrameSource(Protocol):
    """What `open_source` returns."""

    def read(self, timeout: float) -> Frame | None:
        """The next frame (of a camera: the newest that was not read yet); None at the end of a file or folder.

        Raises OSError when the camera is lost; TimeoutError, which is one, when it delivers nothing for `timeout` s.
        """

    def close(self) -> None:
        """Lets go of the device and ends its thread. A `read` that is waiting returns."""


class Device(Protocol):
    """A camera that blocks until it has a frame."""

    def grab(self) -> Frame:
        """The next frame, not counted yet. Raises OSError when the camera is lost."""

    def close(self) -> None: ...


class LiveSource:
    """Newest frame of a device, read by a thread of its own, which also closes it. `line_time`: of its frames."""

    def __init__(self, name: str, device: Device, line_time: float = 0.0) -> None:
        self._name = name
        self._device = device
        self._line_time = line_time
        self._changed = threading.Condition()
        self._frame: Frame | None = None
        self._read = 0
        self._error: OSError | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        self._thread.start()

    def read(self, timeout: float) -> Frame | None:
        """See FrameSource. None after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self._error or self._is_new(), timeout)
            if self._closing:
                return None
            if self._frame is not None and self._is_new():
                self._read = self._frame.sequence
                return self._frame
            if self._error is not None:
                raise self._error
        raise TimeoutError(f"camera {self._name}: no frame for {timeout:g} s")

    def close(self) -> None:
        """See FrameSource."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        # A camera that hangs may hold its thread for longer; it then ends by itself.
        self._thread.join(2.0 * NETWORK_TIMEOUT)

    def _is_new(self) -> bool:
        return self._frame is not None and self._frame.sequence > self._read

    def _run(self) -> None:
        sequence = 0
        try:
            while not self._closing:
                frame = self._device.grab()
                sequence += 1
                with self._changed:
                    self._frame = replace(frame, sequence=sequence, line_time=self._line_time)
                    self._changed.notify_all()
        except (OSError, cv2.error) as error:
            with self._changed:
                self._error = error if isinstance(error, OSError) else OSError(f"camera {self._name}: lost ({error})")
                self._changed.notify_all()
        finally:
            self._device.close()


class FileSource:
    """Pictures in order. `images` yields them; frame k is stamped `start + k / rate_hz`.

    `paced`: each is handed out when its time has come, as a camera would, and the clock waits for a slow reader, so
    that stamps do not fall behind; otherwise at once.
    """

    def __init__(self, images: Iterator[Pixels], rate_hz: float, paced: bool) -> None:
        self._images = images
        self._interval = 1.0 / rate_hz
        self._paced = paced
        self._sequence = 0
        self._start = 0.0
        self._closed = threading.Event()

    def read(self, timeout: float) -> Frame | None:
        """See FrameSource; a file is never late, so that `timeout` means nothing here."""
        if self._closed.is_set():
            return None
        image = next(self._images, None)
        if image is None:
            return None
        if self._sequence == 0:
            self._start = time.monotonic()
        t = self._start + self._sequence * self._interval
        if self._paced:
            late = time.monotonic() - t
            if late > self._interval:
                self._start += late
                t += late
            elif self._closed.wait(max(0.0, -late)):
                return None
        self._sequence += 1
        return Frame(t, image, self._sequence)

    def close(self) -> None:
        """See FrameSource."""
        self._closed.set()


def open_source(source: str | int, settings: CaptureSettings = CAMERAS_OWN, *, paced: bool = True) -> FrameSource:
    """Opens a camera or file.

    `source`: a number or "/dev/videoN" (V4L2), "rtsp://...", "picamera", a video file or a folder of images, which are
    taken in the order of their names. The log says which of the `settings` a camera does not grant. A file runs at its
    own rate, a folder at FOLDER_RATE_HZ, unless `frame_rate_hz` says otherwise; `paced=False` reads them as fast as
    possible. Raises OSError in plain words if it is not there.
    """
    if source == "picamera":
        from camera.picamera import PiCamera  # libcamera only exists on a Raspberry Pi

        return LiveSource("picamera", PiCamera(settings), settings.line_time)
    if isinstance(source, int) or source.isdecimal():
        source = f"/dev/video{source}" if sys.platform.startswith("linux") else int(source)
    if isinstance(source, int) or source.startswith("/dev/"):
        return LiveSource(str(source), V4l2Device(source, settings), settings.line_time)
    if "://" in source:
        return LiveSource(without_password(source), NetworkCamera(source), settings.line_time)
    path = Path(source)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise FileNotFoundError(f"{path}: no image in this folder ({', '.join(sorted(IMAGE_SUFFIXES))})")
        return FileSource(_images(files), settings.frame_rate_hz or FOLDER_RATE_HZ, paced)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such video file, folder of images or camera")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    rate = settings.frame_rate_hz or capture.get(cv2.CAP_PROP_FPS)
    # A file that is no video may still open, as one frame of text, but it has no rate or no size.
    if not capture.isOpened() or not rate > 0.0 or capture.get(cv2.CAP_PROP_FRAME_WIDTH) <= 0.0:
        raise OSError(f"{path}: not a video file that can be read")
    return FileSource(_frames(capture), rate, paced)


def read_image(path: str | os.PathLike[str]) -> Pixels:
    """An image file as (height, width) or (height, width, 3) BGR, 8 or 16 bits, turned upright by its EXIF tag.

    Raises OSError if there is none or it cannot be decoded; the text begins with the path.
    """
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        raise OSError(f"{path}: {error.strerror or error}") from None
    with _stderr_silenced():
        try:
            image = cv2.imdecode(content, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) if content.size else None
        except cv2.error:  # larger than OpenCV's limit
            image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise OSError(f"{path}: not an image that can be read")
    return np.asarray(image)


class V4l2Device:
    """A USB camera, or another with a V4L2 driver; on other systems than Linux what OpenCV finds there.

    An exposure and a gain above 0 end the camera's own automatic exposure.
    """

    def __init__(self, source: str | int, settings: CaptureSettings = CAMERAS_OWN) -> None:
        self._name = str(source)
        self._clock: str | None = None
        if isinstance(source, str):
            _check_device(Path(source))
        with _stderr_silenced():
            # Of a path OpenCV would ask FFmpeg first, to which a device is a file like any other.
            self._capture = cv2.VideoCapture(source, cv2.CAP_V4L2 if isinstance(source, str) else cv2.CAP_ANY)
        if not self._capture.isOpened():
            raise OSError(f"camera {source}: cannot be opened; is it in use by another program?")
        # The pixel format first: which sizes and rates there are depends on it. What came of size and rate is seen in
        # the frames.
        for what, value in (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.pixel_format) if settings.pixel_format else 0),
            (cv2.CAP_PROP_FRAME_WIDTH, settings.width_px),
            (cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px),
            (cv2.CAP_PROP_FPS, settings.frame_rate_hz),
            # V4L2_EXPOSURE_MANUAL: in the dark the automatic lengthens the exposure until all is blur.
            (cv2.CAP_PROP_AUTO_EXPOSURE, 1.0 if settings.exposure_ms or settings.gain else 0.0),
        ):
            if value:
                self._capture.set(what, value)
        granted = self._fix("exposure_ms", cv2.CAP_PROP_EXPOSURE, settings.exposure_ms, unit=_EXPOSURE_UNIT_MS)
        # s, nan where the camera chooses it
        self._exposure = settings.exposure if settings.exposure_ms and granted else math.nan
        self._fix("gain", cv2.CAP_PROP_GAIN, settings.gain)

    def _fix(self, key: str, what: int, value: float, unit: float = 1.0) -> bool:
        """Fix a control at `value`, where that is not 0; whether the camera has taken it."""
        if not value:
            return True
        wanted = float(round(value / unit))
        self._capture.set(what, wanted)
        found = self._capture.get(what)
        if found == wanted:
            return True
        _log.warning("camera %s: %s = %g was asked for, it says %g", self._name, key, value, found * unit)
        return False

    def grab(self) -> Frame:
        """See Device. `t` is the driver's stamp where it has one, else the arrival."""
        if not self._capture.grab():
            raise OSError(f"camera {self._name}: lost; it no longer delivers frames")
        clocks = host_clocks()
        # With V4L2 this is the buffer's stamp; elsewhere the time since the start, or nothing.
        stamped = host_time(1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC), clocks)
        ok, image = self._capture.retrieve()
        if not ok:
            raise OSError(f"camera {self._name}: lost; it delivers frames that cannot be decoded")
        t, clock = stamped or (clocks["monotonic"], "")
        if clock != self._clock:
            self._clock = clock
            how = f"by the driver, on the {clock} clock" if clock else "on arrival, some ms late: the driver does not"
            _log.info("camera %s: frames are stamped %s", self._name, how)
        if clock and math.isfinite(self._exposure):
            # USB cameras' driver, uvcvideo, stamps the start of the exposure (V4L2_BUF_FLAG_TSTAMP_SRC_SOE).
            t += 0.5 * self._exposure
        return Frame(t, np.asarray(image), exposure=self._exposure)

    def close(self) -> None:
        self._capture.release()


class NetworkCamera:
    """A network camera's stream, such as rtsp://..., through FFmpeg."""

    def __init__(self, url: str) -> None:
        self._name = without_password(url)
        limit = int(1000.0 * NETWORK_TIMEOUT)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
        with _stderr_silenced():
            self._capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, limits)
        if not self._capture.isOpened():
            raise OSError(
                f"camera {self._name}: no answer within {NETWORK_TIMEOUT:g} s; check address, user and password"
            )
        # RTP's stamps are of the camera's clock (RFC 3550, section 5.1); those of other streams FFmpeg makes up.
        self._clock = StreamClock() if url.startswith("rtsp") else None

    def grab(self) -> Frame:
        """See Device. `t` is too late by what the promptest frame takes, which is in no stamp."""
        t = None
        while t is None:
            if not self._capture.grab():
                raise OSError(f"camera {self._name}: lost; it no longer delivers frames")
            t = time.monotonic()
            if self._clock is not None:
                t = self._clock.host_time(1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC), t)
        ok, image = self._capture.retrieve()
        if not ok:
            raise OSError(f"camera {self._name}: lost; it delivers frames that cannot be decoded")
        return Frame(t, np.asarray(image))

    def close(self) -> None:
        self._capture.release()


def without_password(url: str) -> str:
    """An address as it may be shown: `rtsp://user:***@host/stream`."""
    return re.sub(r"(?<=://)([^/@:]*):[^/@]*@", r"\1:***@", url)


def _check_device(path: Path) -> None:
    """Raises OSError with what OpenCV does not say: which cameras there are, or that permission is missing."""
    if not path.exists():
        there = ", ".join(str(device) for device in sorted(Path("/dev").glob("video*"))) or "none"
        raise FileNotFoundError(f"camera {path}: not there; cameras found: {there}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise PermissionError(f"camera {path}: no permission; add the user to the group `video`")


def _images(files: list[Path]) -> Iterator[Pixels]:
    for file in files:
        try:
            yield read_image(file)
        except OSError as error:
            # One bad file must not end the others.
            _log.warning("%s; skipped", error)


def _frames(capture: cv2.VideoCapture) -> Iterator[Pixels]:
    try:
        while (frame := capture.read())[0]:
            yield np.asarray(frame[1])
    finally:
        capture.release()


@contextlib.contextmanager
def _stderr_silenced() -> Iterator[None]:
    """Discards what libraries in C write to standard error: the decoders of images have no other switch.

    It is the process's own standard error, so that another thread's words in these milliseconds are lost as well.
    """
    with _stderr_lock:
        sys.stderr.flush()
        kept = os.dup(2)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
