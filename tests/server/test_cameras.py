"""One camera without the service: frames in, fixes and words out."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera.calibration import save_intrinsics
from camera.capture import Frame
from camera.images import Pixels
from fusion.geometry import exp_so3, quaternion_from_rotation, rotation_about_z, transform
from fusion.measurements import Array, Mode, Pose, PoseFix
from server.cameras import PLACEMENT_FRAMES, Camera, Seen
from server.config import parse
from tests.server.room import ANCHORS, CAMERA, CONFIG, INTRINSICS, Ceiling, picture


class Frames:
    """A source of given pictures, at 30 a second."""

    def __init__(self, pictures: Iterable[Pixels], line_time: float = 0.0) -> None:
        self._frames = iter(
            [Frame(100.0 + k / 30.0, image, k + 1, line_time=line_time) for k, image in enumerate(pictures)]
        )

    def read(self, timeout: float) -> Frame | None:
        return next(self._frames, None)

    def close(self) -> None:
        pass


@pytest.fixture
def watch(tmp_path: Path) -> Callable[..., tuple[Camera, list[list[PoseFix]]]]:
    """Has a camera look at pictures: -> the camera, and what fixes came of each."""

    def run(
        pictures: Iterable[Pixels],
        *,
        camera: str = "",
        marker: str = "",
        more: str = "",
        line_time: float = 0.0,
        poses_at: Callable[[float], Mapping[str, Pose]] = lambda t: {},
    ) -> tuple[Camera, list[list[PoseFix]]]:
        save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
        robots = CONFIG.replace("position_m = [0.0, 0.0, 0.1]", f"position_m = [0.0, 0.0, 0.1]\n{marker}")
        config = parse(robots + CAMERA.replace("[[camera]]", f"[[camera]]\n{camera}") + more, folder=tmp_path)
        fixes: list[list[PoseFix]] = []

        def deliver(seen: Seen) -> None:
            fixes.append(list(seen.fixes))

        watching = Camera(
            config.camera[0], config, deliver, open=lambda _: Frames(pictures, line_time), poses_at=poses_at
        )
        watching.start()
        watching.join(60.0)
        assert watching.status == "the source has ended"
        return watching, fixes

    return run


def distance(fix: PoseFix, world_from_body: Array = Ceiling.WORLD_FROM_BODY) -> float:
    return float(np.linalg.norm(fix.hypotheses[0].position - world_from_body[:3, 3]))


def test_a_shaken_camera_sends_the_fixes_of_one_at_rest(watch):
    at_rest, shaken = picture(), [picture(shake=[a, -0.5 * a, 0.7 * a]) for a in (0.002, -0.004, 0.008)]
    camera, fixes = watch([at_rest] * PLACEMENT_FRAMES + shaken)
    assert distance(fixes[PLACEMENT_FRAMES - 1][0]) < 0.002
    # 8 mrad would be 20 mm on the floor.
    assert [distance(fix) < 0.003 for (fix,) in fixes[PLACEMENT_FRAMES:]] == [True] * 3
    assert camera.placement is not None
    np.testing.assert_allclose(camera.placement.world_from_camera[:3, 3], Ceiling.WORLD_FROM_CAMERA[:3, 3], atol=0.005)


def test_an_anchor_that_was_pushed_is_no_shake(watch):
    before, after = (picture(anchors={**ANCHORS, 42: (x, -0.6, 0.0)}) for x in (-0.7, -0.67))
    third = "[[anchor]]\nid = 42\nsize_mm = 180\nposition_m = [-0.7, -0.6, 0.0]"
    _, fixes = watch([before] * PLACEMENT_FRAMES + [after] * 2, more=third)
    assert [distance(fix) < 0.002 for (fix,) in fixes[PLACEMENT_FRAMES:]] == [True] * 2


def test_each_marker_is_stamped_by_its_own_row(watch):
    line_time = 20e-6
    _, fixes = watch([picture()] * 2, line_time=line_time, camera="time_offset = -0.01")
    camera_from_world = np.linalg.inv(Ceiling.WORLD_FROM_CAMERA)
    point = INTRINSICS.camera_matrix @ (camera_from_world @ Ceiling.WORLD_FROM_BODY @ [0.0, 0.0, 0.1, 1.0])[:3]
    row = point[1] / point[2]
    assert fixes[0][0].t == pytest.approx(100.0 - 0.01 + line_time * row, abs=1e-6)


def test_a_marker_on_the_side_of_a_robot(watch):
    # Rolled to its left by 40 degrees, after which it is still seen from above
    roll, pitch, yaw = np.radians([-40.0, 20.0, 90.0])
    R = rotation_about_z(yaw) @ exp_so3([0.0, pitch, 0.0]) @ exp_so3([roll, 0.0, 0.0])
    image = picture(body_from_marker=transform(R, [0.0, 0.0, 0.1]))
    _, fixes = watch([image] * 3, marker="roll_deg = -40\npitch_deg = 20\nyaw_deg = 90")
    (fix,) = fixes[-1]
    assert distance(fix) < 0.003
    assert 2.0 * math.atan2(*fix.hypotheses[0].quaternion_wxyz[[3, 0]]) == pytest.approx(0.5, abs=0.01)


def test_pictures_of_all_kinds_and_black_ones_in_between(watch, caplog):
    grey = np.asarray(picture(), np.uint8)
    black = np.zeros_like(grey)
    kinds = [cv2.cvtColor(grey, cv2.COLOR_GRAY2BGRA), grey.astype(np.uint16) * 200, grey[..., None]]
    with caplog.at_level(logging.INFO, "steadfix.camera"):
        _, fixes = watch([*kinds, black, black, *kinds])
    assert [len(found) for found in fixes] == [1, 1, 1, 0, 0, 1, 1, 1]


def test_a_marker_that_is_there_twice_is_said_and_makes_no_fix(watch, caplog):
    left, right = picture(transform(np.eye(3), [-0.3, -0.2, 0.0])), picture()
    half = left.shape[1] // 2
    image = np.hstack([left[:, :half], right[:, half:]])
    camera, fixes = watch([image] * 25)
    # The very first search may see one of them.
    assert [len(found) for found in fixes[1:]] == [0] * 24
    assert "marker 7 is in view more than once" in camera.advice(0.0)["marker 7"]
    assert any("marker 7 is in view more than once" in record.message for record in caplog.records)


def test_a_blurred_marker_is_followed_where_the_filter_predicts_it(watch):
    """Far apart from frame to frame, and after the first too blurred for a search."""
    places = [
        transform(rotation_about_z(0.3 * k), [0.5 * math.cos(2.0 * k), 0.4 * math.sin(2.0 * k), 0.0]) for k in range(6)
    ]

    def poses_at(t: float) -> dict[str, Pose]:
        pose = places[round(30.0 * (t - 100.0))]
        quaternion, still = quaternion_from_rotation(pose[:3, :3]), np.zeros(3)
        covariance = np.diag([1e-5, 1e-5, 1e-6, 1e-6, 1e-6, 1e-4])
        return {
            "rover": Pose.of(
                "rover", t, pose[:3, 3], quaternion, still, still, covariance, np.eye(3), Mode.FULL, 0, 0.0
            )
        }

    pictures = [picture(place, moved=0.05 if k else 0.0) for k, place in enumerate(places)]
    _, fixes = watch(pictures, poses_at=poses_at)
    assert [distance(found[0], place) < 0.005 for found, place in zip(fixes, places, strict=True)] == [True] * 6
    _, fixes = watch(pictures)
    assert sum(map(len, fixes)) < 4
