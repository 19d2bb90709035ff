import numpy as np
import pytest

from camera.fix import MarkerMount
from camera.floor import Anchor, PlacementError, load_placement, locate_camera, save_placement
from fusion.geometry import quaternion_from_rotation, rotation_about_z, transform
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA, nees, sight

ANCHORS = [
    Anchor(40 + k, 0.15, transform(rotation_about_z(0.7 * k), [x, y, 0.0]))
    for k, (x, y) in enumerate([(-0.8, -0.6), (0.9, -0.6), (0.9, 0.7), (-0.8, 0.7)])
]


def seen(anchors, random, sigma_px=0.1):
    mounts = [MarkerMount(anchor.id, anchor.size, anchor.world_from_marker) for anchor in anchors]
    return sight(mounts, np.eye(4), random, sigma_px)


@pytest.mark.parametrize(("count", "trials"), [(4, 60), (2, 60), (1, 60)])
def test_the_camera_is_where_its_covariance_says(count, trials):
    random = np.random.default_rng(count)
    distances = []
    for _ in range(trials):
        found = locate_camera(seen(ANCHORS[:count], random), ANCHORS, INTRINSICS)
        assert found.anchors_seen == tuple(range(40, 40 + count))
        rotation = quaternion_from_rotation(found.world_from_camera[:3, :3])
        distances.append(nees(WORLD_FROM_CAMERA, found.world_from_camera[:3, 3], rotation, found.covariance))
    # The median of chi-square at 6 degrees of freedom is 5.35; residuals above the expected widen the covariance.
    assert 3.5 < np.median(distances) < 7.0


def test_many_anchors_are_better_than_one():
    random = np.random.default_rng(5)
    one, four = (locate_camera(seen(ANCHORS[:n], random), ANCHORS, INTRINSICS) for n in (1, 4))
    assert np.trace(four.covariance[:3, :3]) < 0.01 * np.trace(one.covariance[:3, :3])
    assert 0.03 < four.rms_px < 0.2


SHIFTED = transform(rotation_about_z(0.7), [0.9, -0.4, 0.0])  # by 0.2 m
TURNED = transform(rotation_about_z(0.7 + np.pi / 2), [0.9, -0.6, 0.0])  # by a right angle


@pytest.mark.parametrize("wrong", [SHIFTED, TURNED], ids=["shifted", "turned"])
def test_an_anchor_that_contradicts_the_others_is_named(wrong):
    believed = [ANCHORS[0], Anchor(41, 0.15, wrong), *ANCHORS[2:]]
    with pytest.raises(PlacementError, match=r"anchor 41 is 0\.\d+ m away .* 40, 42, 43"):
        locate_camera(seen(ANCHORS, np.random.default_rng(6)), believed, INTRINSICS)


def test_of_two_anchors_that_contradict_each_other_both_are_named():
    believed = [ANCHORS[0], Anchor(41, 0.15, TURNED)]
    with pytest.raises(PlacementError, match=r"contradict each other.*40 by.*41 by"):
        locate_camera(seen(ANCHORS[:2], np.random.default_rng(6)), believed, INTRINSICS)


def test_a_survey_that_is_wrong_by_millimetres_is_accepted_and_widens_the_covariance():
    random = np.random.default_rng(7)
    surveyed = [
        Anchor(a.id, a.size, transform(np.eye(3), [*random.normal(0.0, 0.003, 2), 0.0]) @ a.world_from_marker)
        for a in ANCHORS
    ]
    found = locate_camera(seen(ANCHORS, random), surveyed, INTRINSICS)
    exact = locate_camera(seen(ANCHORS, random), ANCHORS, INTRINSICS)
    assert np.trace(found.covariance) > 5.0 * np.trace(exact.covariance)
    assert np.linalg.norm(found.world_from_camera[:3, 3] - WORLD_FROM_CAMERA[:3, 3]) < 0.05


def test_no_anchor_in_view_is_said_with_what_is():
    with pytest.raises(PlacementError, match="40, 41, 42, 43 expected, no marker seen"):
        locate_camera([], ANCHORS, INTRINSICS)
    stranger = seen([Anchor(3, 0.15, np.eye(4))], np.random.default_rng(8))
    with pytest.raises(PlacementError, match="anchor 40 expected, marker 3 seen"):
        locate_camera(stranger, ANCHORS[:1], INTRINSICS)


def test_a_placement_comes_back_exactly_as_it_was_written(tmp_path):
    written = locate_camera(seen(ANCHORS, np.random.default_rng(9)), ANCHORS, INTRINSICS)
    save_placement(tmp_path / "ceiling.toml", written, "two lines\nof comment")
    read = load_placement(tmp_path / "ceiling.toml")
    np.testing.assert_array_equal(read.world_from_camera, written.world_from_camera)
    np.testing.assert_array_equal(read.covariance, written.covariance)
    assert (read.rms_px, read.anchors_seen) == (written.rms_px, written.anchors_seen)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("world_from_camera", "camera_from_world"), "camera_from_world"),
        (("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0, 2.0]"), "world_from_camera"),
        (("    [0.0, 0.0, 0.0, 1.0],\n", ""), "world_from_camera"),
        (("rms_px = ", "rms_px = 'small' #"), "rms_px"),
        (("covariance = [\n    [", "covariance = [\n    [nan, "), "covariance"),
        (("covariance = [\n    [", "covariance = [\n    [-"), "covariance"),
    ],
)
def test_a_wrong_placement_file_is_refused_by_file_and_key(tmp_path, change, says):
    path = tmp_path / "ceiling.toml"
    save_placement(path, locate_camera(seen(ANCHORS, np.random.default_rng(9)), ANCHORS, INTRINSICS))
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(PlacementError) as caught:
        load_placement(path)
    assert str(path) in str(caught.value)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
