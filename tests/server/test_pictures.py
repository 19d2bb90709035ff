"""What a camera of the service is given to see: light that goes out, a file that ends."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from camera.calibration import save_intrinsics
from camera.capture import Frame
from server.config import CameraConfig, Config, parse
from tests.server.room import CAMERA, CONFIG, INTRINSICS, Ceiling, health, run, serving, until


@pytest.fixture
def room(tmp_path: Path) -> Config:
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    return parse(CONFIG + CAMERA, folder=tmp_path)


class Lamp(Ceiling):
    """The room, with a lamp."""

    def __init__(self, config: CameraConfig) -> None:
        super().__init__(config)
        self.on = True
        self._dark = np.random.default_rng(1).integers(0, 4, self._image.shape, np.uint8)

    def read(self, timeout: float) -> Frame | None:
        frame = super().read(timeout)
        assert frame is not None
        return frame if self.on else Frame(frame.t, self._dark, frame.sequence)


def test_light_that_goes_out_is_told_and_makes_no_fix(room: Config) -> None:
    lamps: list[Lamp] = []

    def open_(config: CameraConfig) -> Lamp:
        lamps.append(Lamp(config))
        return lamps[-1]

    async def main() -> None:
        async with serving(room, open_camera=open_) as service:
            camera, rover = service.cameras["ceiling"], service.robots["rover"].localiser

            def fixes() -> int:
                return sum(rover.counts.values())

            await until(lambda: fixes() >= 3)
            assert camera.markers == (7, 40, 41)
            lamps[0].on = False
            await until(lambda: camera.markers == ())
            before, frames = fixes(), camera.frames
            while (await health(service))["cameras"]["ceiling"]["status"] == "ok":
                pass
            await until(lambda: camera.frames >= frames + 20)
            assert fixes() == before
            reasons = (await health(service))["reasons"]
            assert any("camera ceiling: the picture is black (grey level 3 of 255)" in reason for reason in reasons)
            assert camera.placement is not None
            lamps[0].on = True
            await until(lambda: fixes() > before and camera.markers == (7, 40, 41))
            while (await health(service))["cameras"]["ceiling"]["status"] != "ok":
                pass

    run(main)


def test_a_video_that_ends_is_told(room: Config, tmp_path: Path) -> None:
    picture = cv2.cvtColor(Ceiling(room.camera[0])._image, cv2.COLOR_GRAY2BGR)
    writer = cv2.VideoWriter(str(tmp_path / "nothing.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (640, 480))
    for _ in range(15):
        writer.write(picture)
    writer.release()

    async def main() -> None:
        async with serving(room) as service:
            camera = service.cameras["ceiling"]
            await until(lambda: camera.status == "the source has ended")
            assert camera.frames == 15
            assert "camera ceiling: the source has ended" in (await health(service))["reasons"]

    run(main)
