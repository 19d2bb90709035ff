"""One camera of the running service: a thread that turns frames into sightings, a placement and fixes."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera.calibration import CalibrationError, Intrinsics, load_intrinsics
from camera.capture import Frame, FrameSource, open_source
from camera.exposure import Delivery, DeliveryMeter, EdgeBlur, advice, black, blur_px
from camera.fix import Body, MarkerMount, marker_corners, marker_poses, predict, project, rays, solve
from camera.floor import Anchor, Placement, PlacementError, averaged, listed, load_placement, locate_camera
from camera.markers import MarkerSighting
from camera.shake import measure_shake, shaken
from camera.tracking import MarkerTracker, Prediction
from fusion.geometry import exp_so3, inverse, log_so3, rotation_about_z, transform, transform_points
from fusion.measurements import Array, Pose, PoseFix
from server.config import AnchorConfig, CameraConfig, Config, ConfigError, MarkerConfig
from server.frames import FrameThread, Source
from server.messages import tracker_message

log = logging.getLogger("steadfix.camera")

# s before a camera that is not there is tried again: the first pause, which doubles up to the longest.
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 30.0
# Frames whose anchor corners are averaged for one placement, and s between two such looks at the anchors.
PLACEMENT_FRAMES = 10
PLACEMENT_CHECK = 5.0
# A camera counts as moved beyond three sigma and these, m and rad, in two looks in a row.
MOVED_POSITION, MOVED_ROTATION = 0.005, math.radians(0.2)
# s over which the frame rate is counted.
RATE_WINDOW = 2.0
# s for which a piece of advice must not have held until it is told again.
GONE_AFTER = 60.0


@dataclass(frozen=True, slots=True)
class Seen:
    """What came of one frame. `tracker`: messages of the original tracker's stream, if anyone listens."""

    fixes: tuple[PoseFix, ...]
    tracker: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class SightedFrame:
    """A frame that was looked at elsewhere: its stamp (s, host monotonic), its size and what was seen in it.

    `detect_ms`: how long that took. `repeated`: ids that were seen at several places, and left out.
    """

    t: float
    sequence: int
    width_px: int
    height_px: int
    sightings: list[MarkerSighting]
    detect_ms: float
    repeated: frozenset[int]


Open = Callable[[CameraConfig], Source[Frame | SightedFrame]]


def open_configured(config: CameraConfig) -> FrameSource:
    """The source that the configuration names."""
    return open_source(config.source, config)


class Camera:
    """Opens its source, and again whenever that is lost, until `stop`.

    `deliver` is called from the camera's thread, once a frame; `tracker_wanted` tells there whether anyone listens to
    the original stream, whose poses are not free, and `poses_at` says where the robots were at an instant, by name, as
    far as their filters know. `status` says in words what keeps the camera from its work, and is "" where nothing does.
    Raises ConfigError, CalibrationError or OSError for what cannot ever work.
    """

    def __init__(
        self,
        config: CameraConfig,
        room: Config,
        deliver: Callable[[Seen], None],
        tracker_wanted: Callable[[], bool] = lambda: False,
        open: Open = open_configured,
        poses_at: Callable[[float], Mapping[str, Pose]] = lambda t: {},
    ) -> None:
        self.config = config
        self.status = "is being opened"
        self.placement: Placement | None = None
        self.unlocated = "no anchor has been seen yet"
        self.frames = 0
        self.markers: tuple[int, ...] = ()
        # Ids that are in view more than once.
        self.repeated: frozenset[int] = frozenset()
        self.last_frame = -math.inf
        self.detect_ms = math.nan
        self._deliver = deliver
        self._tracker_wanted = tracker_wanted
        self._poses_at = poses_at
        if not Path(config.calibration).is_file():
            raise CalibrationError(
                f'camera "{config.name}": there is no calibration file {config.calibration}. It holds the '
                "focal length and distortion of this very camera at this image size; `steadfix calibrate` makes it. "
                "example-camera.toml, beside example.toml, will do for a first try"
            )
        self.intrinsics = load_intrinsics(config.calibration)
        if config.placement:
            if not Path(config.placement).is_file():
                raise ConfigError(
                    f'camera "{config.name}": there is no placement file {config.placement}; `steadfix floor` writes '
                    "it, or leave the key out and the camera is located from the anchors in view"
                )
            self.placement, self.unlocated = load_placement(config.placement), ""
        self._anchors = [configured_anchor(anchor) for anchor in room.anchor]
        self.anchor_ids = {anchor.id for anchor in room.anchor}
        self._bodies = [
            Body(robot.name, [_mount(marker) for marker in robot.marker], planar=robot.motion != "free")
            for robot in room.robot
        ]
        self._sizes = {marker.id: marker.size for marker in self._anchors}
        self._sizes |= {mount.id: mount.size for body in self._bodies for mount in body.mounts.values()}
        self.ids = frozenset(self._sizes)
        try:
            self._tracking = MarkerTracker(config.dictionary, self.ids, still=self.anchor_ids)
        except ValueError as error:
            raise ConfigError(f'camera "{config.name}": {error}') from None
        self._image_size = (0, 0)
        self._meter = DeliveryMeter()
        self._edges = EdgeBlur()
        # What was told about the picture, and when it was last so.
        self._told: dict[str, float] = {}
        # Anchors as seen in the frames of the present look; whether one whole look has been had; whether the last one
        # found the camera elsewhere.
        self._looks: list[list[MarkerSighting]] = []
        self._next_look = -math.inf
        self._settled = self.placement is not None
        self._moved = False
        # The placement that the tracking knows the size of markers for, and the camera's pose as in the last frame.
        self._sides_of: Placement | None = None
        self._world_from_camera = np.eye(4)
        # Anchors that this camera cannot see from there.
        self._anchors_elsewhere: dict[int, Prediction] = {}
        # The anchors' corners while the camera hangs as it was found to, px, by id.
        self._at_rest: dict[int, Array] = {}
        self._arrivals: deque[float] = deque()
        self._thread = FrameThread(
            f"camera {config.name}",
            lambda: open(config),
            self._take,
            self._lost,
            self._ended,
            (FIRST_PAUSE, LONGEST_PAUSE),
        )

    @property
    def connected(self) -> bool:
        """Whether frames come from where the camera is; of one that is here they do, or its source has raised."""
        return True

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Ask the thread to end; `join` waits for it."""
        self._thread.stop()

    def join(self, timeout: float) -> None:
        if self._thread.ident is not None:
            self._thread.join(timeout)

    def _lost(self, trouble: str) -> None:
        if trouble != self.status:
            log.warning("camera %s: %s; trying again until it works", self.config.name, trouble)
        self.status = trouble

    def _ended(self) -> None:
        self.status = "the source has ended"
        log.info("camera %s: %s", self.config.name, self.status)

    def _take(self, frame: Frame | SightedFrame) -> None:
        seen = self._see(frame)
        # Not before: a frame of the wrong size is no success.
        if self.status and self.connected:
            log.info("camera %s: frames are coming", self.config.name)
            self.status = ""
        self._deliver(seen)

    def _see(self, frame: Frame | SightedFrame) -> Seen:
        arrival = time.monotonic()
        if isinstance(frame, SightedFrame):
            self._take_size(frame.width_px, frame.height_px)
            self._take_repeated(frame.repeated)
            sightings, self.detect_ms = frame.sightings, frame.detect_ms
        else:
            self._take_size(frame.image.shape[1], frame.image.shape[0])
            self._meter.add(frame, arrival)
            sightings = self._track(frame)
            self.detect_ms = (time.monotonic() - arrival) * 1e3
        self.frames += 1
        self.last_frame = arrival
        self.markers = tuple(sorted(sighting.id for sighting in sightings))
        self._edges.add(
            arrival,
            still=(sighting.blur_px for sighting in sightings if sighting.id in self.anchor_ids),
            others=(sighting.blur_px for sighting in sightings if sighting.id not in self.anchor_ids),
        )
        self._arrivals.append(arrival)
        while self._arrivals[0] < arrival - RATE_WINDOW:
            self._arrivals.popleft()
        if arrival >= self._next_look:
            self._look([sighting for sighting in sightings if sighting.id in self.anchor_ids], arrival)
        return Seen(
            fixes=tuple(self._fixes(sightings, arrival)),
            tracker=tuple(self._tracker(sightings)) if self._tracker_wanted() else (),
        )

    def _track(self, frame: Frame) -> list[MarkerSighting]:
        t = frame.t + self.config.time_offset
        predictions = {}
        if (placement := self.placement) is not None:
            if placement is not self._sides_of:
                self._sides_of, self._tracking.sides_px = placement, self._sides_px(placement)
                self._world_from_camera = placement.world_from_camera
                self._anchors_elsewhere = self._out_of_view(placement)
            poses = self._poses_at(t)
            predictions = predict(self._bodies, poses, self.intrinsics, self._world_from_camera, frame.line_time)
            predictions |= self._anchors_elsewhere
        sightings = self._tracking.track(frame.image, t, self.config.name, predictions, frame.line_time)
        self._take_repeated(self._tracking.repeated)
        return sightings

    def _take_repeated(self, repeated: frozenset[int]) -> None:
        if repeated != self.repeated:
            self.repeated = repeated
            for text in self._repetitions().values():
                log.warning("camera %s: %s", self.config.name, text)

    def _misplaced(self) -> dict[str, str]:
        """That its placement file is for another calibration."""
        placement = self.placement
        if placement is None or placement.calibration in ("", self.intrinsics.fingerprint):
            return {}
        text = f"{self.config.placement} was found with another calibration than {self.config.calibration}, and is "
        return {"placement": text + "wrong by what they differ: run `steadfix floor` again"}

    def _repetitions(self) -> dict[str, str]:
        return {
            f"marker {id}": f"marker {id} is in view more than once; which one is meant cannot be told, so none is used"
            for id in sorted(self.repeated)
        }

    def _out_of_view(self, placement: Placement) -> dict[int, Prediction]:
        """Where the anchors should be seen that are far from the picture or behind the camera."""
        size, far = np.array(self._image_size), {}
        for anchor in self._anchors:
            points = transform_points(
                inverse(placement.world_from_camera) @ anchor.world_from_marker, marker_corners(anchor.size)
            )
            behind = points[:, 2].min() < 1e-3
            corners = np.full((4, 2), -1e6) if behind else project(points, self.intrinsics)[0]
            if (corners.max(axis=0) < -0.1 * size).any() or (corners.min(axis=0) > 1.1 * size).any():
                far[anchor.id] = Prediction(corners, 1.0)
        return far

    def _sides_px(self, placement: Placement) -> tuple[float, float]:
        """How long the sides of the smallest and the largest marker appear, anywhere in the picture."""
        mounts = [mount for body in self._bodies for mount in body.mounts.values()]
        heights = [0.0, *(float(mount.body_from_marker[2, 3]) for mount in mounts)]
        u, v = np.meshgrid(*(np.linspace(0.0, size - 1.0, 5) for size in self._image_size))
        directions = (
            rays(np.column_stack([u.ravel(), v.ravel()]), self.intrinsics) @ placement.world_from_camera[:3, :3].T
        )
        above = float(placement.world_from_camera[2, 3])
        # m along the camera's axis to the floor; towards the horizon no marker is found anyway.
        depth = above / np.maximum(-directions[:, 2], 1e-3)
        furthest = min(float(depth.max()), 2.0 * float(np.median(depth)))
        nearest = float(depth.min()) * (1.0 - max(heights) / above)
        focal = float(self.intrinsics.camera_matrix[0, 0])
        # What flies may come as near as it likes.
        flying = not all(body.planar for body in self._bodies)
        sizes = self._sizes.values()
        return focal * min(sizes) / furthest, math.inf if flying or nearest <= 0.0 else focal * max(sizes) / nearest

    def _take_size(self, width_px: int, height_px: int) -> None:
        self.intrinsics.check_size(width_px, height_px)
        self._image_size = (width_px, height_px)

    def _look(self, anchors: list[MarkerSighting], now: float) -> None:
        """Find the camera from its anchors: at once, better with each of the first frames; then keep it and check."""
        if not anchors:
            if self.placement is None:
                self.unlocated = f"no anchor is in view; looking for {listed(sorted(self.anchor_ids), 'marker')}"
            return
        self._looks.append(anchors)
        whole = len(self._looks) >= PLACEMENT_FRAMES
        if self._settled and not whole:
            return
        looks = list(self._looks)
        if whole:
            self._looks.clear()
            self._next_look = now + PLACEMENT_CHECK
        try:
            sightings = averaged(looks)
            found = locate_camera(sightings, self._anchors, self.intrinsics)
        except PlacementError as error:
            if str(error) != self.unlocated:
                log.warning("camera %s: %s", self.config.name, error)
            self.unlocated = str(error)
            return
        self.unlocated = ""
        at_rest = {sighting.id: sighting.corners_px for sighting in sightings}
        if not self._settled:
            if self.placement is None:
                height = float(found.world_from_camera[2, 3])
                log.info("camera %s is located, %.2f m above the floor", self.config.name, height)
            self.placement, self._settled, self._at_rest = found, whole, at_rest
        elif self.placement is not None and (shift := _moved(self.placement, found)) is not None:
            # One look can be wrong, say with a foot on an anchor; two in a row are not.
            if self._moved:
                log.warning("camera %s has moved by %.0f mm, or an anchor has", self.config.name, 1e3 * shift)
                self.placement, self._at_rest = found, at_rest
            self._moved = not self._moved
        else:
            self._moved = False
            # Anchors that were hidden when it was located.
            self._at_rest = at_rest | self._at_rest

    def _fixes(self, sightings: list[MarkerSighting], arrival: float) -> list[PoseFix]:
        placement = self.placement
        if placement is None:
            return []
        world_from_camera, covariance = placement.world_from_camera, placement.covariance
        if (shake := measure_shake(self._at_rest, sightings, self.intrinsics)) is not None:
            world_from_camera, covariance = shaken(world_from_camera, covariance, shake)
        self._world_from_camera = world_from_camera
        return solve(
            self._bodies,
            sightings,
            self.intrinsics,
            world_from_camera,
            arrival=arrival,
            placement_covariance=covariance,
        )

    def _tracker(self, sightings: list[MarkerSighting]) -> Iterator[bytes]:
        for sighting in sightings:
            size = self._sizes[sighting.id]
            for pose in marker_poses(sighting.corners_px, size, self.intrinsics, sighting.sigma_px)[:1]:
                yield tracker_message(sighting.id, sighting.corners_px, pose.camera_from_marker)

    def frame_rate_hz(self, now: float) -> float:
        recent = [t for t in list(self._arrivals) if t >= now - RATE_WINDOW]
        return 0.0 if len(recent) < 2 else (len(recent) - 1) / (recent[-1] - recent[0])

    def delivery(self, now: float) -> Delivery | None:
        """What its source delivers, None where that is not known."""
        return self._meter.delivery(now)

    def advice(self, now: float) -> dict[str, str]:
        """What would make its picture or its fixes better, in words, by what it is about."""
        texts = self._misplaced() | self._repetitions()
        delivery = self.delivery(now)
        if delivery is None:
            return texts
        return texts | advice(
            delivery,
            self._edges,
            focal_px=self._focal_px,
            distance=self._height,
            asked_rate_hz=self.config.frame_rate_hz,
        )

    @property
    def _focal_px(self) -> float:
        return float(self.intrinsics.camera_matrix[0, 0])

    @property
    def _height(self) -> float | None:
        """m above the floor, None while that is not known."""
        height = 0.0 if self.placement is None else float(self.placement.world_from_camera[2, 3])
        return height if height > 0.0 else None

    def news(self, now: float) -> list[str]:
        """What there is to say of its picture that has not been said yet, for the log."""
        texts = self.advice(now)
        if (delivery := self.delivery(now)) is not None and (text := black(delivery)):
            texts["black"] = text
        news = [text for about, text in texts.items() if about not in self._told]
        # Said again when it has been away: one that is at its limit would otherwise come and go.
        self._told = {about: now for about in texts} | {
            about: t for about, t in self._told.items() if about not in texts and now - t < GONE_AFTER
        }
        return news

    def health(self, now: float) -> dict[str, Any]:
        placement = self.placement
        delivery = self.delivery(now)
        exposure = math.nan if delivery is None else delivery.exposure
        height = self._height
        blur = math.nan if height is None else blur_px(exposure, self._focal_px, height)
        return {
            "status": self.status or (black(delivery) if delivery is not None else "") or "ok",
            "advice": list(self.advice(now).values()),
            "frame_rate_hz": round(self.frame_rate_hz(now), 1),
            "frame_age": round(now - self.last_frame, 3) if math.isfinite(self.last_frame) else None,
            "frames": self.frames,
            "detect_ms": round(self.detect_ms, 1) if math.isfinite(self.detect_ms) else None,
            "exposure_ms": round(1e3 * exposure, 3) if math.isfinite(exposure) else None,
            "blur_px_at_1_m_s": round(blur, 1) if math.isfinite(blur) else None,
            "markers": list(self.markers),
            "located": placement is not None,
            "location": self.unlocated or "ok",
            "position_m": None if placement is None else placement.world_from_camera[:3, 3].round(4).tolist(),
            "view_m": None if placement is None else _view_on_floor(placement, self.intrinsics, *self._image_size),
        }


def configured_anchor(config: AnchorConfig) -> Anchor:
    at = transform(rotation_about_z(math.radians(config.yaw_deg)), config.position_m)
    return Anchor(config.id, config.size_mm / 1000.0, at)


def _mount(config: MarkerConfig) -> MarkerMount:
    roll, pitch, yaw = (math.radians(angle) for angle in (config.roll_deg, config.pitch_deg, config.yaw_deg))
    R = rotation_about_z(yaw) @ exp_so3([0.0, pitch, 0.0]) @ exp_so3([roll, 0.0, 0.0])
    return MarkerMount(config.id, config.size_mm / 1000.0, transform(R, config.position_m))


def _moved(kept: Placement, found: Placement) -> float | None:
    """By how many metres a camera has moved on the floor below it, or None if it stands where it was."""
    shift = found.world_from_camera[:3, 3] - kept.world_from_camera[:3, 3]
    turn = log_so3(found.world_from_camera[:3, :3] @ kept.world_from_camera[:3, :3].T)
    sigma = np.sqrt(np.diag(kept.covariance) + np.diag(found.covariance))
    if (np.abs(shift) > np.maximum(3.0 * sigma[:3], MOVED_POSITION)).any() or (
        np.abs(turn) > np.maximum(3.0 * sigma[3:], MOVED_ROTATION)
    ).any():
        return float(np.linalg.norm(shift))
    return None


def _view_on_floor(placement: Placement, intrinsics: Intrinsics, width_px: int, height_px: int) -> list[list[float]]:
    """The outline of what the camera sees of the floor, m: the border of the image cut with z = 0; [] before a picture
    has told its size."""
    if not width_px:
        return []
    u, v = np.linspace(0.0, width_px - 1.0, 9), np.linspace(0.0, height_px - 1.0, 9)
    border = (
        [(x, 0.0) for x in u] + [(u[-1], y) for y in v] + [(x, v[-1]) for x in u[::-1]] + [(0.0, y) for y in v[::-1]]
    )
    directions = rays(np.array(border), intrinsics) @ placement.world_from_camera[:3, :3].T
    camera = placement.world_from_camera[:3, 3]
    # Above the horizon there is no floor; 20 m is as far as one wants to see it.
    down = np.minimum(directions[:, 2], -np.linalg.norm(directions[:, :2], axis=1) * camera[2] / 20.0)
    points: Array = camera[:2] - (camera[2] / down)[:, None] * directions[:, :2]
    outline: list[list[float]] = points.round(3).tolist()
    return outline
