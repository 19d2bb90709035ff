import argparse
import json

import cv2
import numpy as np
import pytest

from camera.calibration import Intrinsics, save_intrinsics
from server import detect
from tests.camera.scene import INTRINSICS
from tests.camera.test_markers import frame
from tests.data import data


@pytest.fixture
def steadfix_detect(capfd):
    """Runs the command: exit status, lines of output, standard error."""

    def run(*arguments):
        parser = argparse.ArgumentParser()
        detect.add_arguments(parser)
        status = detect.run(parser.parse_args([str(argument) for argument in arguments]))
        output = capfd.readouterr()
        assert "Traceback" not in output.err
        return status, output.out.splitlines(), output.err

    return run


@pytest.fixture
def picture(tmp_path):
    image, truth = frame(45)
    cv2.imwrite(str(tmp_path / "room.png"), image)
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    return tmp_path / "room.png", truth


def test_ids_and_corners_as_json_and_as_text(steadfix_detect, picture):
    path, truth = picture
    status, (line,), err = steadfix_detect(path, "--dictionary", "dict_4x4_50", "--json")
    assert (status, err) == (0, "")
    content = json.loads(line)
    assert content["image"] == str(path)
    assert content["ms"] > 0.0
    assert [marker["id"] for marker in content["markers"]] == list(range(6))
    for marker in content["markers"]:
        np.testing.assert_allclose(marker["corners_px"], truth[marker["id"]], atol=0.2)
        assert "poses" not in marker
    status, lines, _ = steadfix_detect(path, "--dictionary", "4X4_50")
    assert status == 0
    assert lines[0].startswith(f"{path}: 6 markers, ")
    assert [line.split()[1] for line in lines[1:]] == ["0", "1", "2", "3", "4", "5"]


def test_poses_with_both_hypotheses(steadfix_detect, picture):
    path, _ = picture
    camera = path.with_name("camera.toml")
    size_mm = 1000 * 45 * 2.9 / 600
    arguments = (path, "--dictionary", "4X4_50", "--camera", camera, "--size-mm", size_mm)
    _, (line,), _ = steadfix_detect(*arguments, "--json")
    for marker in json.loads(line)["markers"]:
        first, second = marker["poses"]
        assert first["misfit"] <= second["misfit"]
        assert first["rms_px"] < 0.1
        assert np.linalg.norm(first["position_m"]) == pytest.approx(first["distance_m"], abs=1e-5)
        assert 2.7 < first["position_m"][2] < 3.1
        assert np.linalg.norm(first["orientation_wxyz"]) == pytest.approx(1.0, abs=1e-5)
    _, lines, _ = steadfix_detect(*arguments)
    assert sum("pose 1: at" in line for line in lines) == sum("pose 2: at" in line for line in lines) == 6


def test_a_bad_image_is_named_and_the_others_are_done(steadfix_detect, picture, tmp_path):
    path, _ = picture
    (tmp_path / "text.png").write_text("no image")
    status, lines, err = steadfix_detect(
        tmp_path / "text.png", tmp_path / "missing.png", path, "--dictionary", "4X4_50", "--json"
    )
    assert status == 1
    contents = [json.loads(line) for line in lines]
    assert [len(content["markers"]) for content in contents] == [0, 0, 6]
    assert [("error" in content) for content in contents] == [True, True, False]
    assert err.splitlines() == [
        f"steadfix detect: {tmp_path / 'text.png'}: not an image that can be read",
        f"steadfix detect: {tmp_path / 'missing.png'}: No such file or directory",
    ]


def test_overlays_show_the_markers_and_never_replace_an_image(steadfix_detect, picture, tmp_path):
    path, truth = picture
    other = tmp_path / "other" / "room.png"
    other.parent.mkdir()
    # 16 bits and grey
    cv2.imwrite(str(other), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16) * 200)
    before = path.read_bytes()
    known = ("--dictionary", "4X4_50", "--json", "--overlay")
    status, lines, _ = steadfix_detect(path, other, *known, tmp_path)
    assert (status, path.read_bytes()) == (0, before)
    overlays = [json.loads(line)["overlay"] for line in lines]
    assert overlays == [str(tmp_path / "room-markers.png"), str(tmp_path / "room-markers-2.png")]
    for overlay in overlays:
        drawn = cv2.imread(overlay).astype(int)
        green = (drawn[..., 1] - drawn[..., 2] > 80) & (drawn[..., 1] - drawn[..., 0] > 80)
        for corners in truth.values():
            x, y = np.rint(corners[0]).astype(int)
            assert green[y, x]
        assert green.mean() < 0.02
    status, lines, err = steadfix_detect(path, *known, path)
    assert (status, lines) == (2, [])
    assert "room.png: File exists" in err
    status, lines, _ = steadfix_detect(path, *known, tmp_path / "new" / "folder")
    assert status == 0
    assert (tmp_path / "new" / "folder" / "room-markers.png").is_file()


def test_a_calibration_for_another_image_size_says_both(steadfix_detect, picture):
    path, _ = picture
    camera = path.with_name("other.toml")
    save_intrinsics(camera, Intrinsics(INTRINSICS.camera_matrix, INTRINSICS.distortion, 1280, 960))
    status, lines, err = steadfix_detect(path, "--dictionary", "4X4_50", "--camera", camera, "--size-mm", 50)
    assert (status, lines) == (1, [])
    assert err == (f"steadfix detect: {path}: the image is 640 x 480 px, the calibration is for 1280 x 960 px\n")


def test_arguments_that_cannot_be_followed(steadfix_detect, picture, tmp_path):
    path, _ = picture
    camera = path.with_name("camera.toml")
    (tmp_path / "keyless.toml").write_text(camera.read_text().replace("camera_matrix", "matrix"))
    known = ("--dictionary", "4X4_50")
    for arguments, says in (
        (("--dictionary", "4X4_51"), "did you mean 4X4_50? There are: 4X4_100, "),
        ((*known, "--camera", camera), "poses need both --camera and --size-mm"),
        ((*known, "--size-mm", 50), "poses need both --camera and --size-mm"),
        ((*known, "--camera", camera, "--size-mm", -50), "--size-mm -50"),
        ((*known, "--camera", camera, "--size-mm", "nan"), "--size-mm nan"),
        ((*known, "--camera", tmp_path / "nowhere.toml", "--size-mm", 50), "nowhere.toml: No such file"),
        ((*known, "--camera", tmp_path / "keyless.toml", "--size-mm", 50), "keyless.toml: "),
        ((*known, "--camera", path, "--size-mm", 50), "room.png: "),
    ):
        status, lines, err = steadfix_detect(path, *arguments)
        assert (status, lines) == (2, [])
        assert says in err
        assert err.count("\n") == 1


def test_the_tag_that_turns_is_found_at_its_distance(steadfix_detect, tmp_path):
    folder = data("apriltag_yaw_series")
    truth = json.loads((folder / "truth.json").read_text())
    width, height = truth["image_size"]
    matrix, distortion = np.array(truth["camera_matrix"]), np.array(truth["distortion"], dtype=float)
    save_intrinsics(tmp_path / "camera.toml", Intrinsics(matrix, distortion, width, height))
    status, lines, _ = steadfix_detect(
        *sorted(folder.glob("*.png")), "--dictionary", truth["dictionary"], "--json",
        "--camera", tmp_path / "camera.toml", "--size-mm", 1000 * truth["size_m"],
    )  # fmt: skip
    assert status == 0
    markers = [marker for line in lines for marker in json.loads(line)["markers"]]
    assert {marker["id"] for marker in markers} == {truth["id"]}
    assert len(markers) >= 14
    assert all(0.20 <= marker["poses"][0]["distance_m"] <= 0.22 for marker in markers)
