import re
from dataclasses import replace

import numpy as np
import pytest

from camera.fix import MarkerMount, chi_square_limit, project, rays
from camera.floor import (
    PRINT_SIGMA,
    SHEET_HEIGHT_SIGMA,
    SHEET_TILT_SIGMA,
    SHEET_YAW_SIGMA,
    SURVEY_SIGMA,
    TAPE_SIGMA,
    Anchor,
    PlacementError,
    Tape,
    averaged,
    floor_sigma,
    load_placement,
    locate_camera,
    save_placement,
    survey,
)
from fusion.geometry import inverse, quaternion_from_rotation, rotation_about_z, transform, transform_points
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA, moved, nees, sight

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
    assert read.calibration == INTRINSICS.fingerprint


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


def room(random, count=4, tapes=False, size=0.15, cameras=None):
    """Anchors as believed and as they are, off by as much as `survey` expects, and what is seen of them."""
    cameras = cameras or {"ceiling": WORLD_FROM_CAMERA}
    sigmas = [SURVEY_SIGMA, SURVEY_SIGMA, SHEET_HEIGHT_SIGMA, SHEET_TILT_SIGMA, SHEET_TILT_SIGMA, SHEET_YAW_SIGMA]
    scale = 1.0 + random.normal(0.0, PRINT_SIGMA)
    true, believed, measured = [], [], []
    for k, anchor in enumerate(ANCHORS[:count]):
        off = random.normal(0.0, sigmas)
        if count == 1:
            off[[0, 1, 5]] = 0.0  # it defines the world
        if tapes and k < 2:
            off[k:2] = 0.0  # the first defines the origin, the second the direction of x
        true.append(Anchor(anchor.id, size * scale, moved(anchor.world_from_marker, off)))
        # With tapes all that is believed is the origin and the height.
        place = transform(np.eye(3), ANCHORS[0].world_from_marker[:3, 3]) if tapes else anchor.world_from_marker
        believed.append(Anchor(anchor.id, size, place))
    if tapes:
        for i in range(count):
            for j in range(i):
                apart = np.linalg.norm(true[i].world_from_marker[:3, 3] - true[j].world_from_marker[:3, 3])
                measured.append(Tape(40 + j, 40 + i, apart + random.normal(0.0, TAPE_SIGMA)))
    mounts = [MarkerMount(anchor.id, anchor.size, anchor.world_from_marker) for anchor in true]
    sightings = [
        replace(sighting, camera=name)
        for name, pose in cameras.items()
        for sighting in sight(mounts, np.eye(4), random, 0.1, pose)
    ]
    return sightings, believed, measured, true


@pytest.mark.parametrize(("count", "tapes"), [(4, False), (2, False), (1, False), (4, True)])
def test_a_survey_is_as_good_as_it_says_in_the_air_and_on_the_floor(count, tapes):
    random = np.random.default_rng(10 + count)
    places = np.array([[0.0, 0.0], [0.5, 0.5], [-0.7, 0.2]])
    world = np.hstack([places, np.zeros((3, 1))])
    seen_at = project(transform_points(inverse(WORLD_FROM_CAMERA), world), INTRINSICS)[0]
    distances, normalised = [], []
    for _ in range(24):
        sightings, believed, measured, _ = room(random, count, tapes)
        found = survey(sightings, believed, {"ceiling": INTRINSICS}, measured).placements["ceiling"]
        camera = found.world_from_camera[:3, 3]
        rotation = quaternion_from_rotation(found.world_from_camera[:3, :3])
        distances.append(nees(WORLD_FROM_CAMERA, camera, rotation, found.covariance))
        directions = rays(seen_at, INTRINSICS) @ found.world_from_camera[:3, :3].T
        hit = camera - (camera[2] / directions[:, 2])[:, None] * directions
        normalised.append(np.linalg.norm((hit - world)[:, :2], axis=1) / floor_sigma(found, INTRINSICS, places))
    # The mean of 24 values of chi-square at 6 degrees of freedom: 6 +- 3 sigma of 0.71.
    assert 3.9 < np.mean(distances) < 8.1
    assert 0.7 < np.sqrt(np.mean(np.square(normalised))) < 1.3


def test_tapes_give_the_layout_that_nobody_surveyed():
    sightings, believed, measured, true = room(np.random.default_rng(20), 4, tapes=True)
    found = survey(sightings, believed, {"ceiling": INTRINSICS}, measured)
    assert found.doubts == ()
    for anchor, truth in zip(found.anchors, true, strict=True):
        off = anchor.world_from_marker[:2, 3] - truth.world_from_marker[:2, 3]
        assert np.linalg.norm(off) < 4.0 * max(found.sigmas[anchor.id], 1e-9) < 0.02
    # The first defines the world; its turn has been found.
    assert found.sigmas[40] == 0.0
    assert found.print_scale == pytest.approx(true[0].size / 0.15, abs=2e-3)


def test_two_cameras_share_a_world_through_an_anchor_that_both_see():
    random = np.random.default_rng(21)
    cameras = {"west": WORLD_FROM_CAMERA, "east": moved(WORLD_FROM_CAMERA, np.array([0.5, 0.1, 0.1, 0, 0, 0.3]))}
    sightings, believed, measured, _ = room(random, 4, True, cameras=cameras)
    # Only 41 is seen by both.
    sightings = [s for s in sightings if s.id == 41 or (s.camera == "west") == (s.id in (40, 42))]
    both = {"west": INTRINSICS, "east": INTRINSICS}
    found = survey(sightings, believed, both, measured)
    for name, pose in cameras.items():
        rotation = quaternion_from_rotation(found.placements[name].world_from_camera[:3, :3])
        place = found.placements[name]
        assert nees(pose, place.world_from_camera[:3, 3], rotation, place.covariance) < chi_square_limit(6)
    apart = [s for s in sightings if not (s.camera == "east" and s.id == 41)]
    with pytest.raises(PlacementError, match=r"camera (west|east) sees no anchor that another camera sees"):
        survey(apart, believed, both, measured)


def test_a_tape_that_contradicts_the_others_is_named():
    sightings, believed, measured, _ = room(np.random.default_rng(22), 4, tapes=True)
    k = next(k for k, tape in enumerate(measured) if str(tape) == "41-43")
    for error, refused in ((0.02, False), (0.3, True)):
        wrong = [*measured]
        wrong[k] = replace(measured[k], length=measured[k].length + error)
        if refused:
            with pytest.raises(PlacementError) as caught:
                survey(sightings, believed, {"ceiling": INTRINSICS}, wrong)
            words = str(caught.value)
        else:
            (words,) = survey(sightings, believed, {"ceiling": INTRINSICS}, wrong).doubts
        said = re.match(r"tape 41-43 says (\d+) mm, everything else (\d+) mm", words)
        assert said is not None
        assert int(said[1]) == round(1e3 * wrong[k].length)
        assert int(said[2]) == pytest.approx(1e3 * measured[k].length, abs=12.0)


def test_an_anchor_that_is_centimetres_off_is_doubted_by_name():
    random = np.random.default_rng(23)
    sightings, believed, _, true = room(random)
    assert survey(sightings, believed, {"ceiling": INTRINSICS}).doubts == ()
    away = transform(np.eye(3), [0.035, 0.0, 0.0]) @ true[2].world_from_marker
    believed[2] = replace(believed[2], world_from_marker=away)
    (doubt,) = survey(sightings, believed, {"ceiling": INTRINSICS}).doubts
    assert re.match(r"anchor 42 is [34]\d mm from where anchors 40, 41, 43 put it", doubt)


@pytest.mark.parametrize("wrong", range(4))
@pytest.mark.parametrize("size", [0.1, 0.4])
def test_the_right_one_of_four_is_blamed_wherever_it_is_believed(wrong, size):
    random = np.random.default_rng(30 + wrong)
    for way in np.arange(4) * np.pi / 2.0 + 0.3:
        sightings, believed, _, _ = room(random)
        away = transform(np.eye(3), [size * np.cos(way), size * np.sin(way), 0.0])
        place = away @ believed[wrong].world_from_marker
        believed[wrong] = replace(believed[wrong], world_from_marker=place)
        with pytest.raises(PlacementError, match=rf"anchor {40 + wrong} is "):
            survey(sightings, believed, {"ceiling": INTRINSICS})


def test_a_print_of_another_size_is_told_from_tapes_that_are_right():
    sightings, believed, measured, _ = room(np.random.default_rng(24), 4, tapes=True, size=0.145)
    said = [replace(anchor, size=0.15) for anchor in believed]
    (doubt,) = survey(sightings, said, {"ceiling": INTRINSICS}, measured).doubts
    assert re.match(r"the markers are 9[67]\.\d % as large as size_mm says", doubt)


def test_a_tape_to_an_anchor_out_of_view_says_which():
    sightings, believed, measured, _ = room(np.random.default_rng(25), 4, tapes=True)
    for tape, words in (
        (Tape(41, 99, 1.0), r"tape 41-99: anchor 99 is not in view, and not in the configuration"),
        (Tape(41, 40, 1.0), r"tape 41-40: anchor 40 is not in view$"),
    ):
        with pytest.raises(PlacementError, match=words):
            survey(sightings[1:], believed, {"ceiling": INTRINSICS}, [tape])
    with pytest.raises(PlacementError, match=r"camera dark: no anchor is in view: anchors 40, .* no marker seen"):
        survey(sightings, believed, {"ceiling": INTRINSICS, "dark": INTRINSICS}, measured)


def test_a_calibration_that_is_not_sure_makes_the_floor_unsure():
    sightings, believed, _, _ = room(np.random.default_rng(26))
    sigmas = []
    for intrinsics in (INTRINSICS, replace(INTRINSICS, sigma_px=2.0)):
        found = survey(sightings, believed, {"ceiling": intrinsics}).placements["ceiling"]
        sigmas.append(floor_sigma(found, intrinsics, np.array([[0.0, 0.0]]))[0])
    # 2 px each way at 600 px of focal length and 3 m are 14 mm.
    assert sigmas[1] > 0.014 > 2.0 * sigmas[0]


def test_averaging_takes_noise_away_and_refuses_a_marker_in_two_places():
    random = np.random.default_rng(27)
    looks = [seen(ANCHORS, random, 1.0) for _ in range(100)]
    exact = {sighting.id: sighting.corners_px for sighting in seen(ANCHORS, random, 0.0)}
    for sighting in averaged(looks):
        assert np.abs(sighting.corners_px - exact[sighting.id]).max() < 0.5
        assert sighting.sigma_px == 1.0
    looks[3].append(replace(looks[3][0], corners_px=looks[3][0].corners_px + 100.0))
    with pytest.raises(PlacementError, match=r"marker 40 is in the picture 2 times, at \d+, \d+ px and \d+, \d+ px"):
        averaged(looks)
