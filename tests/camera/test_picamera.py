import importlib.util
import sys

import numpy as np
import pytest

from camera.picamera import PiCamera, host_time, y_plane


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


@pytest.mark.parametrize("suspended", [0, 3_600_000_000_000])
@pytest.mark.parametrize("clock", ["monotonic", "boottime"])
def test_sensor_stamps_of_either_clock_come_out_on_the_monotonic_one(suspended, clock):
    now = 5_000_000_000_000
    taken = now - 30_000_000
    stamp = taken if clock == "monotonic" else taken + suspended
    assert host_time(stamp, now, now + suspended) == pytest.approx(taken * 1e-9, abs=1e-9)
