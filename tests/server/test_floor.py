"""`steadfix floor`, and the service with what it wrote."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from camera.calibration import Intrinsics, save_intrinsics
from camera.floor import Placement, load_placement, save_placement
from camera.synthetic import Room, straight_down
from fusion.geometry import exp_so3, rotation_about_z, transform
from server.cameras import PLACEMENT_FRAMES, Camera
from server.config import load, parse
from server.remote_cameras import RemoteCamera
from tests.server.command import steadfix
from tests.server.room import CONFIG, INTRINSICS, Ceiling, run, serving, until

CAMERA = Intrinsics(
    np.array([[800.0, 0.0, 479.5], [0.0, 800.0, 359.5], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.03, 0.0, 0.0, 0.0]),
    960,
    720,
)
WORLD_FROM_CAMERA = straight_down(0.1, 0.05, 2.6, 0.1) @ transform(exp_so3([0.05, -0.04, 0.0]), np.zeros(3))
# id -> x, y (m), yaw (rad)
PLACES = {40: (-1.0, -0.7, 0.1), 41: (1.1, -0.7, 0.9), 42: (1.1, 0.8, -0.4), 43: (-1.0, 0.8, 2.0)}
Places = Mapping[int, tuple[float, float, float]]


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    at = {id: transform(rotation_about_z(yaw), [x, y, 0.0]) for id, (x, y, yaw) in PLACES.items()}
    room = Room(CAMERA, WORLD_FROM_CAMERA, "4X4_50", 1)
    return room.render({id: (0.15, pose, pose) for id, pose in at.items()})


@pytest.fixture
def folder(tmp_path: Path, picture: np.ndarray) -> Path:
    (tmp_path / "frames").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), picture)
    save_intrinsics(tmp_path / "camera.toml", CAMERA)
    write(tmp_path)
    return tmp_path


def write(folder: Path, places: Places = PLACES, more: str = "") -> None:
    """room.toml with the anchors at these places."""
    lines = ["[[camera]]", 'name = "ceiling"', 'source = "frames"', 'calibration = "camera.toml"', more]
    for id, (x, y, yaw) in places.items():
        lines += ["[[anchor]]", f"id = {id}", "size_mm = 150", f"position_m = [{x}, {y}, 0.0]"]
        lines.append(f"yaw_deg = {np.degrees(yaw)}")
    (folder / "room.toml").write_text("\n".join(lines) + "\n")


def test_a_live_camera_is_located_and_the_error_told(capfd: pytest.CaptureFixture[str], folder: Path) -> None:
    status, text, err = steadfix(capfd, "floor", folder / "room.toml")
    assert status == 0
    written = folder / "ceiling-placement.toml"
    assert err.splitlines() == [
        "steadfix floor: camera ceiling sees anchors 40, 41, 42, 43",
        f"steadfix floor: {written} is written",
        'steadfix floor: for the service to use it, add to [[camera]] "ceiling": placement = "ceiling-placement.toml"',
    ]
    found = load_placement(written)
    # The picture is exact: what is left is well within what the survey is taken to be good for.
    error = found.world_from_camera[:3, 3] - WORLD_FROM_CAMERA[:3, 3]
    assert (np.abs(error) < np.sqrt(np.diag(found.covariance)[:3])).all()
    assert found.anchors_seen == (40, 41, 42, 43)
    numbers = re.search(r"error on the floor: typically ([\d.]+) mm, at worst ([\d.]+) mm", text)
    assert numbers is not None
    # Surveyed to 5 mm: no better than half of that in the middle, no worse than a few times that at the border.
    assert 2.0 < float(numbers[1]) < float(numbers[2]) < 15.0
    # The map has the anchors' area in it, north up.
    rows = [line.split()[1] for line in text.splitlines() if line.startswith("  y")]
    assert float(rows[0]) > float(rows[-1])


def test_pictures_and_json(capfd: pytest.CaptureFixture[str], folder: Path) -> None:
    out = folder / "there.toml"
    status, text, _ = steadfix(
        capfd, "floor", folder / "room.toml", folder / "frames" / "0.png", "--out", out, "--json"
    )
    assert status == 0
    content = json.loads(text)
    camera = content["cameras"]["ceiling"]
    assert camera["written"] == str(out)
    assert camera["anchors"] == [40, 41, 42, 43]
    error = np.subtract(camera["position_m"], WORLD_FROM_CAMERA[:3, 3])
    assert (np.abs(error) < camera["sigma_m"]).all()
    assert max(camera["sigma_m"]) < 0.01
    assert content["doubts"] == []
    assert content["print_scale"] == pytest.approx(1.0, abs=1e-3)
    assert len(camera["floor_mm"]) > 10
    for x, y, error in camera["floor_mm"]:
        assert abs(x) < 3.0
        assert abs(y) < 3.0
        assert 2.0 < error < 15.0


def test_one_anchor_is_a_quick_start_that_says_what_it_is(capfd: pytest.CaptureFixture[str], folder: Path) -> None:
    _, text, _ = steadfix(capfd, "floor", folder / "room.toml", "--json")
    four = max(error for *_, error in json.loads(text)["cameras"]["ceiling"]["floor_mm"])
    write(folder, {40: PLACES[40]})
    status, text, _ = steadfix(capfd, "floor", folder / "room.toml", "--json")
    assert status == 0
    assert max(error for *_, error in json.loads(text)["cameras"]["ceiling"]["floor_mm"]) > 3.0 * four
    assert "a quick start" in steadfix(capfd, "floor", folder / "room.toml")[1]


def test_tapes_alone(capfd: pytest.CaptureFixture[str], folder: Path) -> None:
    write(folder, dict.fromkeys(PLACES, (0.0, 0.0, 0.0)))
    tapes = ["--tape", "40-41:2100mm", "--tape", "41-42:1.5m", "--tape", "42-43:210cm", "--tape", "40-43:1502mm"]
    status, text, err = steadfix(capfd, "floor", folder / "room.toml", *tapes)
    assert status == 0
    assert "put the [[anchor]] sections above into" in err
    assert re.search(r"^tape 40-43: 1502 mm measured, 150[012]\.\d mm found$", text, re.MULTILINE)
    # What it says is a configuration: with it the camera is where it is with the tapes.
    sections = text[text.index("[[anchor]]") :]
    places = parse('[[camera]]\nname="c"\nsource="f"\ncalibration="c"\n' + sections).anchor
    assert [anchor.id for anchor in places] == [40, 41, 42, 43]
    assert places[0].position_m[:2] == (0.0, 0.0)
    np.testing.assert_allclose(places[2].position_m, [2.1, 1.5, 0.0], atol=6e-3)
    assert places[1].yaw_deg == pytest.approx(np.degrees(0.9), abs=0.3)
    by_tapes = load_placement(folder / "ceiling-placement.toml").world_from_camera
    write(folder, {a.id: (*a.position_m[:2], np.radians(a.yaw_deg)) for a in places})
    assert steadfix(capfd, "floor", folder / "room.toml")[0] == 0
    surveyed = load_placement(folder / "ceiling-placement.toml").world_from_camera
    np.testing.assert_allclose(surveyed, by_tapes, atol=3e-3)


@pytest.mark.parametrize(
    ("change", "tapes", "says"),
    [
        ({42: (1.1, 1.0, -0.4)}, [], "anchor 42 is 0.20 m away from where anchors 40, 41, 43 put it"),
        ({42: (1.1, 0.84, -0.4)}, [], "DOUBT: anchor 42 is 4"),
        (
            {},
            ["40-41:2100mm", "41-42:1.9m", "42-43:210cm", "40-42:2581mm"],
            "tape 41-42 says 1900 mm, everything else 1",
        ),
        ({}, ["40-44:2100mm"], "tape 40-44: anchor 44 is not in view, and not in the configuration"),
        ({}, ["40-41:2100"], "'2100' is no length; 25mm"),
        ({}, ["40-40:2100mm"], "'40-40:2100mm' is no distance between two anchors; 40-41:2003mm is"),
        ({}, ["40:2100mm"], "is no distance between two anchors"),
    ],
)
def test_what_contradicts_is_named(
    capfd: pytest.CaptureFixture[str], folder: Path, change: Places, tapes: list[str], says: str
) -> None:
    write(folder, {**PLACES, **change})
    arguments = [argument for tape in tapes for argument in ("--tape", tape)]
    status, text, err = steadfix(capfd, "floor", folder / "room.toml", *arguments)
    assert says in err
    doubted = says.startswith("DOUBT")
    assert status == (0 if doubted else 2)
    assert (folder / "ceiling-placement.toml").exists() == doubted
    if not doubted:
        assert text == ""


def test_bad_input(capfd: pytest.CaptureFixture[str], folder: Path, picture: np.ndarray) -> None:
    room = folder / "room.toml"
    twice = picture.copy()
    side = cv2.resize(picture, (480, 360))
    twice[:360, 480:] = side  # everything once more, small
    cv2.imwrite(str(folder / "twice.png"), twice)
    cv2.imwrite(str(folder / "black.png"), np.zeros_like(picture))
    cv2.imwrite(str(folder / "small.png"), side)
    for arguments, status, says in (
        ((room, folder / "black.png"), 2, "camera ceiling: no anchor is in view: anchors 40, 41, 42, 43 expected, no"),
        ((room, folder / "small.png"), 2, "the image is 480 x 360 px, the calibration is for 960 x 720 px"),
        ((room, folder / "gone.png"), 1, "gone.png: No such file"),
        ((room, room), 1, "room.toml: not an image that can be read"),
        ((room, "--camera", "floor"), 2, 'no camera "floor" in the configuration; there: ceiling'),
        ((folder / "none.toml",), 1, "none.toml: no such file"),
        ((folder,), 1, "is a directory"),
    ):
        found, text, err = steadfix(capfd, "floor", *arguments)
        assert says in err
        assert (found, text) == (status, "")
    assert list(folder.glob("*placement*")) == []


def test_a_marker_that_is_there_twice_is_named(capfd: pytest.CaptureFixture[str], folder: Path) -> None:
    at = {id: transform(rotation_about_z(yaw), [x, y, 0.0]) for id, (x, y, yaw) in PLACES.items()}
    room = Room(CAMERA, WORLD_FROM_CAMERA, "4X4_50", 1)
    image = room.render({41: (0.15, at[41], at[41]), 42: (0.15, at[42], at[42])})
    other = room.render({41: (0.15, at[43], at[43])})
    image[:, :480] = other[:, :480]
    cv2.imwrite(str(folder / "twice.png"), image)
    status, _, err = steadfix(capfd, "floor", folder / "room.toml", folder / "twice.png")
    assert status == 2
    assert re.search(
        r"marker 41 is in the picture 2 times, at \d+, \d+ px and \d+, \d+ px: two sheets with one id", err
    )


def test_the_service_uses_what_was_written_where_no_anchor_is_in_view(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    camera = '[[camera]]\nname = "ceiling"\nsource = 0\ncalibration = "camera.toml"\n'
    anchors = "".join(
        f"[[anchor]]\nid = {id}\nsize_mm = 180\nposition_m = [{x}, {-x}, 0.0]\n" for id, x in ((40, 0.6), (41, -0.6))
    )
    (tmp_path / "room.toml").write_text(camera + anchors)
    config = parse(camera + anchors, folder=tmp_path)
    cv2.imwrite(str(tmp_path / "seen.png"), Ceiling(config.camera[0]).read(1.0).image)  # type: ignore[union-attr]
    assert steadfix(capfd, "floor", tmp_path / "room.toml", tmp_path / "seen.png")[0] == 0

    async def main() -> None:
        # No [[anchor]] at all: only the file says where the camera hangs.
        placed = camera + 'placement = "ceiling-placement.toml"\n'
        async with serving(parse(CONFIG + placed, folder=tmp_path), open_camera=Ceiling) as service:
            assert service.cameras["ceiling"].unlocated == ""
            assert service.cameras["ceiling"].advice(0.0) == {}
            await until(
                lambda: service.robots["rover"].localiser.pose_at(service.cameras["ceiling"].last_frame) is not None
            )
            pose = service.robots["rover"].localiser.pose_at(service.cameras["ceiling"].last_frame)
            assert pose is not None
            np.testing.assert_allclose(pose.position[:2], Ceiling.WORLD_FROM_BODY[:2, 3], atol=0.03)

    run(main)


@pytest.mark.parametrize(("source", "kind"), [("frames", Camera), ("remote", RemoteCamera)])
def test_a_placement_of_another_calibration_is_said_until_it_is_found_again(
    capfd: pytest.CaptureFixture[str], folder: Path, source: str, kind: type[Camera]
) -> None:
    picture = folder / "frames" / "0.png"
    write(folder, more='placement = "there.toml"\n')
    config = folder / "room.toml"

    def said() -> dict[str, str]:
        room = load(config)
        return kind(msgspec.structs.replace(room.camera[0], source=source), room, lambda seen: None).advice(0.0)

    assert steadfix(capfd, "floor", config, picture)[0] == 0
    assert said() == {}
    # Only the file of the calibration is written anew: its lens is what it was.
    save_intrinsics(folder / "camera.toml", replace(CAMERA, rms_px=0.2))
    assert said() == {}
    save_intrinsics(
        folder / "camera.toml", replace(CAMERA, camera_matrix=CAMERA.camera_matrix * [[1.01], [1.0], [1.0]])
    )
    (text,) = said().values()
    assert f"there.toml was found with another calibration than {folder / 'camera.toml'}" in text
    assert "run `steadfix floor` again" in text
    assert steadfix(capfd, "floor", config, picture)[0] == 0
    assert said() == {}


def test_a_placement_is_kept_while_the_anchors_in_view_agree(tmp_path: Path) -> None:
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    camera = '[[camera]]\nname = "ceiling"\nsource = 0\ncalibration = "camera.toml"\nplacement = "there.toml"\n'
    anchors = "".join(
        f"[[anchor]]\nid = {id}\nsize_mm = 180\nposition_m = [{x}, {-x}, 0.0]\n" for id, x in ((40, 0.6), (41, -0.6))
    )
    config = parse(CONFIG + camera + anchors, folder=tmp_path)

    there = Ceiling.WORLD_FROM_CAMERA
    save_placement(tmp_path / "there.toml", Placement(there, 1e-6 * np.eye(6), 0.1, (40, 41)))

    async def main() -> None:
        # Before its first picture it is located, but what it sees of the floor is not known.
        unseen = Camera(config.camera[0], config, lambda seen: None).health(0.0)
        assert (unseen["located"], unseen["view_m"]) == (True, [])
        async with serving(config, open_camera=Ceiling) as service:
            ceiling = service.cameras["ceiling"]
            await until(lambda: ceiling.frames > 2 * PLACEMENT_FRAMES)
            assert ceiling.placement is not None
            np.testing.assert_array_equal(ceiling.placement.world_from_camera, there)

    run(main)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "there is no placement file"),
        ("rms_px = 1.0\n", "there.toml: "),
        ("world_from_camera = 3", "there.toml: "),
    ],
)
def test_a_placement_that_cannot_be_used_ends_the_service_in_words(tmp_path: Path, text: str | None, says: str) -> None:
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    if text is not None:
        (tmp_path / "there.toml").write_text(text)
    camera = '[[camera]]\nname = "c"\nsource = 0\ncalibration = "camera.toml"\nplacement = "there.toml"\n'

    async def main() -> None:
        async with serving(parse(CONFIG + camera, folder=tmp_path), open_camera=Ceiling):
            pass

    with pytest.raises(ValueError, match=re.escape(says)):
        run(main)
