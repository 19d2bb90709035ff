import importlib.util
import logging
import sys
import time
import types

import numpy as np
import pytest

from camera.capture import open_source
from camera.picamera import EXPOSURE, GAIN, TIMEOUT, PiCamera, y_plane
from camera.settings import CaptureSettings


@pytest.mark.skipif(importlib.util.find_spec("picamera2") is not None, reason="picamera2 is installed here")
def test_without_picamera2_the_error_says_how_to_install_it():
    with pytest.raises(OSError, match=r"apt install python3-picamera2.*--system-site-packages"):
        PiCamera()


def test_importing_the_module_imports_no_libcamera():
    assert "picamera2" not in sys.modules


def test_the_y_plane_is_cut_out_of_padded_rows():
    width, height, stride = 6, 4, 8
    buffer = np.full((height * 3 // 2, stride), 128, np.uint8)
    image = np.arange(24, dtype=np.uint8).reshape(height, width)
    buffer[:height, :width] = image
    cropped = y_plane(buffer, width, height)
    np.testing.assert_array_equal(cropped, image)
    assert cropped.flags["C_CONTIGUOUS"]
    buffer[:] = 0
    np.testing.assert_array_equal(cropped, image)


class Picamera2:
    """What picamera2's manual says of the parts that are used, with a sensor that the test moves."""

    latest = None
    camera_controls = frozenset({"LensPosition"})
    # s: before now, when the sensor stamped the frame; of its exposure, None for what was asked.
    age, exposure = 0.02, None

    def __init__(self):
        Picamera2.latest = self
        self.held = 0
        self.started = self.closed = False
        self.failure = None

    def create_video_configuration(self, **wish):
        return wish

    def configure(self, configuration):
        self.asked = configuration
        width, height = configuration["main"]["size"]
        # libcamera rounds sizes to what the hardware can do.
        self.size = (width - width % 2, height - height % 2)

    def camera_configuration(self):
        return {"main": {"size": self.size, "format": "YUV420"}}

    def start(self):
        self.started = True

    def capture_request(self, wait):
        if self.failure is not None:
            raise self.failure
        self.waited = wait
        self.held += 1
        return self

    def get_metadata(self):
        asked = self.asked["controls"]["ExposureTime"]
        stamp = time.monotonic_ns() - round(1e9 * self.age)
        exposure = asked if self.exposure is None else round(1e6 * self.exposure)
        return {"SensorTimestamp": stamp, "ExposureTime": exposure}

    def make_array(self, name):
        assert name == "main"
        width, height = self.size
        return np.full((height * 3 // 2, width + 32), 77, np.uint8)

    def release(self):
        self.held -= 1

    def stop(self):
        self.started = False

    def close(self):
        self.closed = True


@pytest.fixture
def pi(monkeypatch):
    monkeypatch.setitem(sys.modules, "picamera2", types.SimpleNamespace(Picamera2=Picamera2))
    return Picamera2


def test_exposure_and_gain_are_fixed_and_stamps_are_mid_exposure(pi, caplog):
    caplog.set_level(logging.INFO)
    settings = CaptureSettings(
        width_px=641, height_px=480, frame_rate_hz=30.0, exposure_ms=2.0, gain=8.0, line_time=19e-6
    )
    source = open_source("picamera", settings)
    frame = source.read(10.0)
    source.close()
    camera = pi.latest
    assert camera.asked["main"] == {"format": "YUV420", "size": (641, 480)}
    assert camera.asked["queue"] is False
    assert camera.asked["controls"] == {
        "AeEnable": False,
        "ExposureTime": 2000,
        "AnalogueGain": 8.0,
        "FrameRate": 30.0,
        "AfMode": 0,
        "LensPosition": 0.0,
    }
    assert frame.image.shape == (480, 640)
    assert (frame.exposure, frame.line_time) == (0.002, 19e-6)
    assert time.monotonic() - frame.t >= 0.021
    assert (camera.held, camera.started, camera.closed, camera.waited) == (0, False, True, TIMEOUT)
    assert "frames are stamped by the sensor, on the monotonic clock" in caplog.text


def test_what_is_fixed_where_nothing_is_asked_for(pi):
    PiCamera()
    controls = pi.latest.asked["controls"]
    assert (controls["ExposureTime"], controls["AnalogueGain"]) == (round(1e6 * EXPOSURE), GAIN)


def test_an_exposure_that_is_not_granted_and_a_stamp_of_no_clock_are_said_once(pi, caplog, monkeypatch):
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(pi, "exposure", 0.01)
    monkeypatch.setattr(pi, "age", -1000.0)
    camera = PiCamera(CaptureSettings(exposure_ms=50.0))
    begin = time.monotonic()
    frames = [camera.grab() for _ in range(3)]
    assert begin - 0.005 <= frames[0].t <= time.monotonic() - 0.005
    assert [record.getMessage() for record in caplog.records] == [
        "camera picamera: exposure_ms = 50 was asked for, it has 10; the frame rate limits it",
        "camera picamera: frames are stamped on arrival: the sensor's stamp fits no clock",
    ]


@pytest.mark.parametrize("failure", [RuntimeError("Camera frontend has timed out!"), TimeoutError()])
def test_a_camera_that_is_lost_is_an_oserror(pi, failure):
    camera = PiCamera()
    camera.grab()
    pi.latest.failure = failure
    with pytest.raises(OSError, match="camera picamera: lost"):
        camera.grab()
    assert pi.latest.held == 0
