import numpy as np
import pytest

from camera.calibration import CalibrationError, Intrinsics, load_intrinsics, save_intrinsics

GOOD = """
width_px = 640
height_px = 480
camera_matrix = [[600.0, 0.0, 319.5], [0.0, 601.0, 239.5], [0.0, 0.0, 1.0]]
distortion = [0.1, -0.2, 0.0, 0.0, 0.01]
"""


def test_a_file_comes_back_exactly_as_it_was_written(tmp_path):
    matrix = np.array([[1006.126, 0.0, 655.864], [0.0, 1004.015, 490.614], [0.0, 0.0, 1.0]])
    for written in (
        Intrinsics(matrix, np.array([0.1 + 0.2, -1e-17, 0.0, 3.0, 5e20]), 1280, 960, 0.21),
        Intrinsics(matrix, np.array([])),
    ):
        save_intrinsics(tmp_path / "camera.toml", written)
        read = load_intrinsics(tmp_path / "camera.toml")
        np.testing.assert_array_equal(read.camera_matrix, written.camera_matrix)
        np.testing.assert_array_equal(read.distortion, written.distortion)
        assert (read.width_px, read.height_px, read.rms_px) == (written.width_px, written.height_px, written.rms_px)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("camera_matrix", "cameramatrix"), "cameramatrix"),
        (("distortion =", "# distortion ="), "distortion"),
        (("[0.0, 601.0, 239.5], ", ""), "camera_matrix"),
        (("601.0", "-601.0"), "camera_matrix"),
        (("[0.0, 0.0, 1.0]", "[0.0, 0.0, 2.0]"), "camera_matrix"),
        (("0.1, -0.2", "0.1"), None),
        (("0.1, -0.2, 0.0, 0.0, 0.01", "0.1, -0.2, 0.3"), "distortion"),
        (("0.1, -0.2", "nan, -0.2"), "distortion"),
        (("width_px = 640", "width_px = -640"), "width_px"),
        (("height_px = 480", ""), "height_px"),
        (("640", "'wide'"), "width_px"),
        (("[0.1", "[[0.1"), ""),
    ],
)
def test_a_wrong_file_is_refused_by_file_and_key(tmp_path, change, says):
    path = tmp_path / "camera.toml"
    path.write_text(GOOD.replace(*change))
    if says is None:
        assert len(load_intrinsics(path).distortion) == 4
        return
    with pytest.raises(CalibrationError) as caught:
        load_intrinsics(path)
    assert str(path) in str(caught.value)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_another_image_size_is_refused_naming_both(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(GOOD)
    intrinsics = load_intrinsics(path)
    intrinsics.check_size(640, 480)
    with pytest.raises(CalibrationError, match=r"1280 x 960.*640 x 480"):
        intrinsics.check_size(1280, 960)
    path.write_text(GOOD.replace("width_px = 640", "").replace("height_px = 480", ""))
    load_intrinsics(path).check_size(1280, 960)
