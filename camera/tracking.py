"""Markers in the frames of a stream: followed from one to the next, looked for again when they are lost.

A marker whose place is known to a few pixels has only its edges measured and its picture compared. Where that fails it
is looked for around its place, at first in the cheapest way that finds a sharp marker. While one is missing, the whole
picture is searched now and then.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from camera.images import Image, Pixels, grey
from camera.markers import ENLARGE_UP_TO, SMALLEST_SIDE_PX, Box, Found, MarkerDetector, MarkerSighting, Pass, distinct
from fusion.measurements import Array

# A place is good enough for edges alone up to this sigma, px, ...
NEAR_PX = 3.0
# ... for this long after the marker was told from all others, s, which is tried again this often, s.
DECODED_WITHIN, DECODE_EVERY = 2.0, 0.25
# s for which a marker's own motion tells where it may be.
REMEMBERED = 1.0
# Sigma of where a marker is by what it did before, px, and of how it may speed up or turn meanwhile, in sides of the
# marker per s²: 3 m/s² for one of 14 cm.
_SIGMA_PX, _SWERVE = 1.0, 20.0
# Frames in a row without a marker after which it is no longer looked for in every one.
_GIVEN_UP = 5
# Frames, and s, between two searches of the whole picture while a marker is missing.
SEARCH_EVERY, SEARCH_INTERVAL = 10, 0.5
# s between two while none is missing, lest one is there twice, or where nobody thinks that it is.
SWEEP_INTERVAL = 5.0

# Of markers that are still, so many are looked at in a frame: enough to tell a shaken camera from a marker that moved.
STILL_AT_ONCE = 4

# Around a marker's place: one window is enough for one that is sharp and well lit, three find most others.
_NEARBY = (Pass(windows=(13, 13, 10), darker=10.0), Pass())
# The whole picture: the cheap ways, which find nearly all sharp markers whose sides are long, short and tiny, px, ...
_LONG, _SHORT, _TINY = (
    Pass(0.5, windows=(13, 13, 10), darker=10.0),
    Pass(windows=(13, 13, 10), darker=10.0),
    Pass(2.0, windows=(13, 23, 10)),
)
_LONG_PX, _SHORT_PX = 25.0, 18.0
# ... all that OpenCV's detector does by itself, ...
_THOROUGH = Pass()
# ... and, in turn, the ways that find what is blurred or dark, and what is that and tiny.
_HARD = (Pass(0.5, equalise=True, windows=(13, 13, 10)), Pass(0.25), Pass(equalise=True))
_HARD_AND_TINY = (*_HARD, Pass(2.0, windows=(5, 45, 20)))


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where a marker should be seen: its corners (4, 2), px, and the standard deviation of either coordinate, px.

    `shape_px`: that of the corners about where the marker's middle and heading put them: 0 from a model, since size and
    perspective are known.
    """

    corners_px: Array
    sigma_px: float
    shape_px: float = 0.0


@dataclass(slots=True)
class _Track:
    """A marker as last seen. `t`: when; `earlier`: when and where before; `decoded`: when it was last told from all
    others, s."""

    t: float
    corners_px: Array
    sigma_px: float
    earlier: tuple[float, Array] | None
    blur_px: float
    decoded: float


class MarkerTracker:
    """Follows the markers `ids` of one dictionary; of those, `still` are at rest before a camera at rest.

    For one thread, like the MarkerDetector that it has. Raises what that raises.
    `sides_px`: how long the sides of the smallest and the largest marker are expected to be, where that is known.
    `repeated`: ids that the last search saw at several places, which are left out: which one is meant, nobody knows.
    """

    def __init__(self, dictionary: str, ids: Collection[int], still: Collection[int] = ()) -> None:
        self.ids = frozenset(ids)
        self.sides_px: tuple[float, float] | None = None
        self.repeated: frozenset[int] = frozenset()
        self._still = frozenset(still)
        self._detector = MarkerDetector(dictionary, ids)
        self._tracks: dict[int, _Track] = {}
        # Frames since a marker was last seen, of those that were.
        self._missed: dict[int, int] = {}
        self._since_search = 0
        self._searched = self._swept = -math.inf
        # Which of the hard ways is tried next: the one that last found something, for as long as it does.
        self._hard = 0

    def track(
        self,
        image: Pixels,
        t: float,
        camera: str = "",
        predictions: Mapping[int, Prediction] | None = None,
        line_time: float = 0.0,
    ) -> list[MarkerSighting]:
        """The markers of the next frame, by id. `image` as in `grey`; `t`: s, mid-exposure of its first row.

        `predictions` by id, from whoever knows more than the last frames tell; what is predicted out of the picture is
        not missed there. `line_time`: s from one row's exposure
        to the next one's; each sighting is stamped by the row of its middle.
        """
        picture = grey(image)
        # Those that were looked at longest ago have their turn.
        in_view = [id for id in self._still & self._tracks.keys() if self._missed[id] <= _GIVEN_UP]
        resting = frozenset(sorted(in_view, key=lambda id: self._tracks[id].t)[STILL_AT_ONCE:])
        predictions = predictions or {}
        elsewhere = _out_of_picture(predictions, picture.shape)
        expected = self._expected(t, predictions, resting)
        found = self._follow(picture, t, expected)
        # Where a prediction did not help, it may be wrong, and the robot where it was.
        missed = {id: self._continued(id, t) or where for id, where in expected.items() if id not in found}
        if missed:
            found |= self._look_nearby(picture, missed)
        self._since_search += 1
        at_rest = self._still & self._tracks.keys()
        # While one of them is where it was, the camera is too, and another that is not seen is hidden, not lost.
        hidden = at_rest - found.keys() if at_rest & found.keys() else frozenset()
        if missing := self.ids - found.keys() - hidden - elsewhere:
            due = self._since_search >= SEARCH_EVERY or not 0.0 <= t - self._searched < SEARCH_INTERVAL
            if due or any(self._missed.get(id) == 0 for id in missing):
                found = self._search(picture, found, missing)
                self._since_search, self._searched = 0, t
        elif not 0.0 <= t - self._swept < SWEEP_INTERVAL:
            found = self._search(picture, found, missing)
            self._swept = t
        self._remember(found, t, resting)
        return [
            MarkerSighting(
                t + line_time * float(marker.corners_px[:, 1].mean()) if line_time else t,
                camera,
                id,
                marker.corners_px,
                marker.sigma_px,
                marker.blur_px,
            )
            for id, marker in sorted(found.items())
        ]

    def _expected(
        self, t: float, predictions: Mapping[int, Prediction], resting: Collection[int]
    ) -> dict[int, Prediction]:
        """Where to look: as predicted, unless what the last frames tell is better."""
        expected = {id: where for id, where in predictions.items() if id in self.ids}
        for id in self._tracks:
            if id in expected and expected[id].sigma_px <= NEAR_PX:
                continue
            own = self._continued(id, t)
            if own is not None and (id not in expected or own.sigma_px < expected[id].sigma_px):
                expected[id] = own
        return {
            id: where
            for id, where in expected.items()
            if id not in self.repeated and id not in resting and self._worth_a_look(id)
        }

    def _worth_a_look(self, id: int) -> bool:
        """In every frame, if it was seen lately, else now and then."""
        missed = self._missed.get(id, 0)
        return missed <= _GIVEN_UP or missed % SEARCH_EVERY == 0

    def _continued(self, id: int, t: float) -> Prediction | None:
        """Where a marker is that was seen lately, if it goes on as it did."""
        track = self._tracks.get(id)
        if track is None:
            return None
        if id in self._still:
            return Prediction(track.corners_px, _SIGMA_PX, track.sigma_px)
        dt = t - track.t
        if not 0.0 <= dt <= REMEMBERED:
            return None
        corners = track.corners_px
        if track.earlier is not None and 0.0 < track.t - track.earlier[0] <= REMEMBERED:
            corners = corners + (corners - track.earlier[1]) * (dt / (track.t - track.earlier[0]))
        side = float(np.linalg.norm(track.corners_px[1] - track.corners_px[0]))
        sigma = _SIGMA_PX + 0.5 * _SWERVE * side * dt * dt
        return Prediction(corners, sigma, track.sigma_px)

    def _follow(self, picture: Image, t: float, expected: Mapping[int, Prediction]) -> dict[int, Found]:
        """Those whose place and identity are known well enough for a look at their edges."""
        near = [
            id
            for id, where in expected.items()
            if where.sigma_px <= NEAR_PX
            and (track := self._tracks.get(id)) is not None
            and 0.0 <= t - track.decoded <= DECODED_WITHIN
        ]
        if not near:
            return {}
        tracks = [self._tracks[id] for id in near]
        found = self._detector.follow(
            picture,
            near,
            np.array([expected[id].corners_px for id in near]),
            np.array([expected[id].shape_px for id in near]),
            np.array([3.0 * (expected[id].sigma_px + track.blur_px) for id, track in zip(near, tracks, strict=True)]),
            np.array([t - track.decoded >= DECODE_EVERY for track in tracks]),
        )
        return {marker.id: marker for marker in found if marker is not None}

    def _look_nearby(self, picture: Image, missed: Mapping[int, Prediction]) -> dict[int, Found]:
        """The others around where they should be."""
        found: dict[int, Found] = {}
        for way in _NEARBY:
            left = {id: where for id, where in missed.items() if id not in found}
            boxes, sides = [], []
            for where in left.values():
                side = max(float(np.linalg.norm(where.corners_px[1] - where.corners_px[0])), SMALLEST_SIDE_PX)
                margin = 0.25 * side + 3.0 + 3.0 * where.sigma_px
                if (box := _box(where.corners_px, margin, picture.shape)) is not None:
                    boxes.append(box)
                    sides.append(side)
            if not boxes:
                break
            looked = self._detector.look(picture, way, _about(min(sides), max(sides)), boxes)
            found |= _nearest([marker for marker in looked if marker.id in left], left)
        return found

    def _search(self, picture: Image, found: dict[int, Found], missing: Collection[int]) -> dict[int, Found]:
        """The whole picture: cheaply; while one is missing, with everything that the default detector does, too, and in
        one way more."""
        shortest, longest = self.sides_px or (math.inf, math.inf)
        cheap = (_LONG, _SHORT) if shortest >= _LONG_PX else (_SHORT,) if shortest >= _SHORT_PX else (_TINY,)
        hard = _HARD if self.sides_px is not None and shortest >= _SHORT_PX else _HARD_AND_TINY
        last = hard[self._hard % len(hard)]
        expected = nearly = SMALLEST_SIDE_PX, math.inf
        if self.sides_px is not None:
            # The thorough look is at much else, too, lest a size in the configuration is wrong.
            expected, nearly = _about(shortest, longest), (max(0.4 * shortest, SMALLEST_SIDE_PX), math.inf)
        seen = list(found.values())
        if self.repeated or not missing:
            # The best of them: the others may see one of two.
            cheap = cheap[-1:]
        for way in (*cheap, _THOROUGH, last) if missing else cheap:
            if way.scale > 1.0 and picture.size > ENLARGE_UP_TO:
                continue
            before = len(seen)
            seen = distinct(seen + self._detector.look(picture, way, nearly if way == _THOROUGH else expected))
            if set(missing) <= {marker.id for marker in seen}:
                break
        else:
            self._hard += len(seen) == before
        by_id: dict[int, list[Found]] = {}
        for marker in seen:
            by_id.setdefault(marker.id, []).append(marker)
        self.repeated = frozenset(id for id, markers in by_id.items() if len(markers) > 1)
        return {id: markers[0] for id, markers in by_id.items() if id not in self.repeated}

    def _remember(self, found: Mapping[int, Found], t: float, resting: Collection[int]) -> None:
        for id in self._missed:
            self._missed[id] += id not in resting
        for id, marker in found.items():
            before = self._tracks.get(id)
            earlier = None if before is None else (before.t, before.corners_px)
            decoded = t if marker.decoded or before is None else before.decoded
            self._tracks[id] = _Track(t, marker.corners_px, marker.sigma_px, earlier, marker.blur_px, decoded)
            self._missed[id] = 0


def _out_of_picture(predictions: Mapping[int, Prediction], shape: tuple[int, ...]) -> set[int]:
    if not predictions:
        return set()
    corners = np.array([where.corners_px for where in predictions.values()])
    margin = 3.0 * np.array([where.sigma_px for where in predictions.values()])[:, None]
    out = (corners.max(axis=1) < -margin) | (corners.min(axis=1) > np.array(shape[1::-1]) + margin)
    return {id for id, (x, y) in zip(predictions, out.tolist(), strict=True) if x or y}


def _about(shortest_px: float, longest_px: float) -> tuple[float, float]:
    """Bounds that a detector's rough quadrilaterals keep to, of markers whose sides are expected to be so long."""
    return 0.6 * shortest_px, 1.5 * longest_px


def _box(corners_px: Array, margin: float, shape: tuple[int, ...]) -> Box | None:
    """The part of the picture around some corners; None where nothing is left of it."""
    left, top = np.floor(corners_px.min(axis=0) - margin).tolist()
    right, bottom = np.ceil(corners_px.max(axis=0) + margin + 1.0).tolist()
    box = max(int(left), 0), max(int(top), 0), min(int(right), shape[1]), min(int(bottom), shape[0])
    return box if box[2] - box[0] >= SMALLEST_SIDE_PX and box[3] - box[1] >= SMALLEST_SIDE_PX else None


def _nearest(found: Collection[Found], expected: Mapping[int, Prediction]) -> dict[int, Found]:
    """Of several of one id the one nearest to its place."""
    nearest: dict[int, Found] = {}
    distance: dict[int, float] = {}
    for marker in found:
        off = float(np.linalg.norm(marker.corners_px.mean(axis=0) - expected[marker.id].corners_px.mean(axis=0)))
        if off < distance.get(marker.id, math.inf):
            nearest[marker.id], distance[marker.id] = marker, off
    return nearest
