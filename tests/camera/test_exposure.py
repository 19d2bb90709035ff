import math

import numpy as np
import pytest

from camera.calibration import Intrinsics
from camera.capture import Frame
from camera.exposure import BLUR_COUNT, BLUR_WINDOW, Delivery, DeliveryMeter, EdgeBlur, advice, black, blur_px
from camera.markers import MarkerDetector
from camera.synthetic import Room, straight_down
from fusion.geometry import rotation_about_z, transform

GOOD = Delivery(rate_hz=30.0, used_hz=30.0, exposure=0.002, white=180.0, saturated=0.0)


def with_(**changes):
    return Delivery(**{name: getattr(GOOD, name) for name in Delivery.__slots__} | changes)


def told(delivery, distance=3.0, focal_px=1140.0, asked_rate_hz=0.0, edges=None):
    edges = edges or EdgeBlur()
    return list(advice(delivery, edges, focal_px=focal_px, distance=distance, asked_rate_hz=asked_rate_hz).values())


def test_the_blur_is_how_far_a_marker_moves_in_a_rendered_picture():
    """At 1 m/s below a camera that looks straight down, with the shutter open for 10 ms."""
    intrinsics = Intrinsics(
        np.array([[900.0, 0.0, 319.5], [0.0, 900.0, 239.5], [0.0, 0.0, 1.0]]), np.zeros(5), 640, 480
    )
    room = Room(intrinsics, straight_down(0.0, 0.0, 2.5), "4X4_50")
    start, end = (room.corners_px(0.1, transform(np.eye(3), [x, 0.2, 0.0])) for x in (0.1, 0.1 + 1.0 * 0.01))
    moved = np.linalg.norm(end - start, axis=1)
    assert blur_px(0.01, 900.0, 2.5) == pytest.approx(moved.mean(), rel=1e-6) == 3.6


def seen_edges(lens_px, smear_px):
    """The blur that the detector measures of a marker at rest and one that moves by `smear_px` while it is exposed."""
    intrinsics = Intrinsics(
        np.array([[900.0, 0.0, 319.5], [0.0, 900.0, 239.5], [0.0, 0.0, 1.0]]), np.zeros(5), 640, 480
    )
    room = Room(intrinsics, straight_down(0.0, 0.0, 3.0), "4X4_50", 1)
    detector, edges = MarkerDetector("4X4_50", [7, 8]), EdgeBlur()
    still, start = (transform(rotation_about_z(0.3), [x, 0.1, 0.0]) for x in (-0.5, 0.4))
    for k in range(4):
        end = start.copy()
        end[:2, 3] += smear_px * 3.0 / 900.0 * np.array([math.cos(k), math.sin(k)])
        image = room.render({7: (0.14, still, still), 8: (0.14, start, end)}, blur_px=lens_px)
        by_id = {sighting.id: sighting.blur_px for sighting in detector.search(image)}
        for _ in range(BLUR_COUNT // 4):
            edges.add(0.1 * k, [by_id[7]], [by_id[8]])
    return edges


def test_the_smear_of_a_rendered_marker_is_measured_and_told_where_the_exposure_is_not_known():
    edges = seen_edges(0.6, 6.0)
    assert 4.0 < edges.motion_px() <= 6.0
    assert told(GOOD, edges=edges) == [], "of a known exposure it is told what it does at a known speed"
    (text,) = told(with_(exposure=math.nan), edges=edges)
    assert text == (
        f"robots that move are smeared by {edges.motion_px():.1f} px: fix a shorter exposure, with exposure_ms or, "
        "where that is not taken, in the camera's own settings"
    )
    assert told(with_(exposure=math.nan), edges=seen_edges(0.6, 0.0)) == []
    assert told(with_(exposure=math.nan), edges=EdgeBlur()) == []


def test_a_lens_out_of_focus_is_told():
    (text,) = told(GOOD, edges=seen_edges(2.5, 0.0))
    assert text.startswith("edges at rest are 1.")
    assert text.endswith("px wide (sigma): is the lens out of focus, or dirty?")
    assert all("focus" not in text for text in told(with_(white=20.0), edges=seen_edges(2.5, 0.0)))


def test_a_few_edges_are_not_enough_and_old_ones_are_forgotten():
    edges = EdgeBlur()
    edges.add(0.0, [2.0] * (BLUR_COUNT - 1), [math.nan])
    assert math.isnan(edges.still_px())
    assert math.isnan(edges.motion_px())
    edges.add(1.0, [2.0], [4.0] * BLUR_COUNT)
    assert edges.still_px() == 2.0
    assert edges.motion_px() == pytest.approx(12.0)
    edges.add(1.0 + 2.0 * BLUR_WINDOW, [1.0] * BLUR_COUNT, [1.0] * BLUR_COUNT)
    assert (edges.still_px(), edges.motion_px()) == (1.0, 0.0)


def test_a_good_picture_needs_no_advice():
    assert told(GOOD, asked_rate_hz=30.0) == []
    assert black(GOOD) == ""


def test_blur_is_told_with_what_to_do_about_it():
    assert told(with_(exposure=0.01)) == [
        "3.8 px of blur at 1 m/s: halve the exposure, from 10 to 5 ms; below 10 ms lamps that flicker with the mains "
        "are seen to"
    ]
    assert told(with_(exposure=0.02, white=100.0), distance=2.0) == [
        "11.4 px of blur at 1 m/s: quarter the exposure, from 20 to 5 ms, and make up for it with light or gain; below "
        "10 ms lamps that flicker with the mains are seen to"
    ]
    assert told(with_(exposure=0.009), distance=2.0) == [
        "5.1 px of blur at 1 m/s: halve the exposure, from 9 to 4.5 ms"
    ]
    (text,) = told(with_(exposure=0.1))
    assert text.startswith("38.0 px of blur at 1 m/s: shorten the exposure, from 100 to 6.25 ms")


def test_what_is_advised_is_enough():
    for exposure in (0.008, 0.0081, 0.02, 0.033, 0.5):
        for text in told(with_(exposure=exposure)):
            target = 1e-3 * float(text.split(" ms")[0].rsplit(" ", 1)[1])
            assert blur_px(target, 1140.0, 3.0) <= 3.05
            assert told(with_(exposure=target / 1.02)) == []


@pytest.mark.parametrize("exposure", [math.nan, 0.0])
def test_an_exposure_that_is_not_known_is_no_blur(exposure):
    assert told(with_(exposure=exposure)) == []


def test_without_a_place_there_is_no_blur():
    assert told(with_(exposure=0.1), distance=None) == []


def test_light():
    assert told(with_(white=40.0)) == [
        "the picture is dark (white is grey level 40 of 255): more light is best, else more gain"
    ]
    assert told(with_(saturated=0.3)) == ["30% of the picture is saturated: less gain or a shorter exposure"]
    assert told(with_(white=math.nan, saturated=math.nan)) == []
    assert told(with_(white=3.0)) == [], "a black picture is no matter of a little more light"
    assert black(with_(white=3.0)).startswith("the picture is black (grey level 3 of 255): is the lens covered")
    assert black(with_(white=math.nan)) == ""


def test_frame_rates():
    assert told(with_(rate_hz=10.0, used_hz=10.0), asked_rate_hz=30.0) == [
        "10 frames a second come where 30 were asked for: a compressed pixel_format may be needed to get them through "
        "USB"
    ]
    assert told(with_(rate_hz=20.0, used_hz=20.0, exposure=0.05), asked_rate_hz=30.0, distance=None) == [
        "20 frames a second come where 30 were asked for: an exposure of 50 ms leaves time for no more"
    ]
    assert told(with_(used_hz=9.0)) == [
        "9 of 30 frames a second are looked at, since this computer is too slow for more: a smaller picture makes it "
        "faster"
    ]


def picture(level, sequence=1, dtype=np.uint8, share=1.0):
    image = np.zeros((400, 400), dtype)
    image[: round(400 * share)] = level
    return Frame(0.0, image, sequence, exposure=0.004)


def test_the_meter_measures_what_comes():
    meter = DeliveryMeter()
    assert meter.delivery(0.0).rate_hz == 0.0
    # 40 a second are delivered, every fourth is looked at.
    for k in range(50):
        meter.add(picture(200, 4 * k), 100.0 + 0.1 * k)
    delivery = meter.delivery(104.9)
    assert (delivery.rate_hz, delivery.used_hz) == pytest.approx((40.0, 10.0))
    assert (delivery.exposure, delivery.white, delivery.saturated) == (0.004, 200.0, 0.0)
    assert meter.delivery(110.0).rate_hz == 0.0, "what was delivered long ago is no rate"


def test_the_meter_sees_the_light_go_out_within_a_second():
    meter = DeliveryMeter()
    meter.add(picture(200, 1), 0.0)
    for k in range(2, 12):
        meter.add(picture(1, k), 0.1 * k)
    assert black(meter.delivery(1.2))
    meter.add(picture(255, 13, share=0.25), 2.5)
    assert meter.delivery(2.5).saturated == pytest.approx(0.25, abs=0.02)


def test_a_source_that_is_opened_anew_counts_anew():
    meter = DeliveryMeter()
    for k in range(5):
        meter.add(picture(200, 100 + k), 0.1 * k)
    for k in range(5):
        meter.add(picture(200, 1 + k), 0.5 + 0.1 * k)
    assert meter.delivery(0.9).rate_hz == pytest.approx(10.0)


def test_sixteen_bits_have_no_grey_level_that_means_anything():
    meter = DeliveryMeter()
    meter.add(picture(900, dtype=np.uint16), 0.0)
    assert math.isnan(meter.delivery(0.0).white)
    assert told(meter.delivery(0.0)) == []


def test_colour():
    meter = DeliveryMeter()
    meter.add(Frame(0.0, np.full((80, 80, 3), (0, 120, 0), np.uint8), 1), 0.0)
    assert 60.0 < meter.delivery(0.0).white < 80.0
