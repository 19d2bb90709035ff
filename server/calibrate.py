"""`steadfix calibrate`: a camera's focal length and distortion, from pictures of a board: live or from files."""

from __future__ import annotations

import argparse
import asyncio
import datetime
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from camera.boards import DEFAULT_BOARD, Board, BoardDetector, BoardView, parse_board
from camera.calibration import Calibration, CalibrationError, Criterion, calibrate, coverage, judge, save_intrinsics
from camera.capture import IMAGE_SUFFIXES, FrameSource, open_source, read_image
from camera.guide import Guide, Step
from camera.images import Pixels, grey
from camera.settings import CaptureSettings
from server.calibration_page import CalibrationPage
from server.listening import is_local, own_address, port_number, reachable

DEFAULT_PORT = 5679
# s without a frame after which a camera counts as lost; s before it is tried again, doubled up to the longest.
READ_TIMEOUT, FIRST_PAUSE, LONGEST_PAUSE = 5.0, 1.0, 30.0
# s without the board after which the picture is searched for what is there instead; that takes a while.
_PUZZLED = 3.0
# s between two pictures for the page, and px that they are across at most.
_PICTURE_INTERVAL, _PICTURE_PX = 0.1, 960


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("images", nargs="*", metavar="IMAGE", help="pictures of the board, or folders of them")
    parser.add_argument(
        "--source",
        metavar="SOURCE",
        help='a live camera instead, guided: 0, "/dev/video2", "rtsp://...", "picamera", or a video or folder as one',
    )
    parser.add_argument("--width-px", type=_pixels, default=0, metavar="W", help="asked of the live camera")
    parser.add_argument("--height-px", type=_pixels, default=0, metavar="H", help="asked of the live camera")
    parser.add_argument("--host", default="127.0.0.1", help="address of the guiding page (default: %(default)s)")
    parser.add_argument(
        "--port", type=port_number, default=DEFAULT_PORT, help="its port, 0 for any free one (default: %(default)s)"
    )
    parser.add_argument(
        "--board",
        default=DEFAULT_BOARD,
        metavar="BOARD",
        help="as printed on its sheet: chessboard:9x6:25mm has 9 x 6 inner corners, charuco:8x6:30mm has 8 x 6 squares "
        "(default: %(default)s)",
    )
    parser.add_argument("--out", required=True, type=Path, metavar="CAMERA.toml", help="the calibration file to write")
    parser.add_argument("--force", action="store_true", help="write it even where it is not good enough")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def _pixels(text: str) -> int:
    if not (text.isdecimal() and text.isascii() and 0 < int(text) <= 20000):
        raise argparse.ArgumentTypeError(f"{text!r}: a whole number of pixels is needed")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Runs the command. Returns 0 if the calibration was written; 1 if it was refused, or a picture could not be read;
    2 for arguments that cannot be followed."""
    board = parse_board(args.board)
    if bool(args.images) == (args.source is not None):
        return _fail("name pictures of the board, or --source for a live camera", 2)
    if args.out.is_dir() or not args.out.absolute().parent.is_dir():
        return _fail(f"--out {args.out}: a file in a folder that is there is needed", 2)
    if args.source is not None:
        guided = Guided(args, board)
        try:
            return asyncio.run(guided.run())
        except KeyboardInterrupt:
            if not args.force:
                _say(f"stopped with {len(guided.guide.views)} views: {args.out} is not written")
                raise
            return _finish(args, guided.guide.used, guided.guide.calibration, "too few views")
    views, failed = _views(_files(args.images), BoardDetector(board))
    try:
        calibration = calibrate(board, views)
    except CalibrationError as error:
        # What else there is to say about the views is said all the same.
        return _finish(args, views, None, str(error)) or int(failed)
    return _finish(args, views, calibration, "") or int(failed)


def _files(images: Sequence[str]) -> Iterator[Path]:
    for image in map(Path, images):
        if image.is_dir():
            yield from sorted(file for file in image.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
        else:
            yield image


def _views(files: Iterator[Path], detector: BoardDetector) -> tuple[list[BoardView], bool]:
    """The board in each picture, and whether one could not be read. Says why where there is none."""
    views: list[BoardView] = []
    failed = False
    count = 0
    for path in files:
        count += 1
        try:
            image = read_image(path)
            view = detector.find(image, path.name)
        except (OSError, ValueError) as error:
            failed = True
            _say(str(error) if str(error).startswith(str(path)) else f"{path}: {error}")
            continue
        if view is None:
            _say(f"{path}: no {detector.board}: {detector.what_is_there(image)}")
        elif (same := next((other for other in views if view.same_as(other)), None)) is not None:
            _say(f"{path}: left out, the board is where it is in {same.name}")
        else:
            views.append(view)
    _say(f"the board is in {len(views)} of {count} picture{'s' * (count != 1)}")
    return views, failed


class Guided:
    """The live camera with its guide, on the terminal and on the page."""

    def __init__(
        self,
        args: argparse.Namespace,
        board: Board,
        open: Callable[[str, CaptureSettings], FrameSource] = open_source,
    ) -> None:
        self.guide = Guide(board)
        self._args = args
        self._open_source = open
        self._detector = BoardDetector(board)
        self._said = ""
        self._boardless = time.monotonic()
        self._puzzle = ""
        self._next_picture = 0.0

    async def run(self) -> int:
        """Until it is good enough, or the source has ended. Returns the exit status."""
        source: FrameSource | None = await asyncio.to_thread(self._open)
        pause = FIRST_PAUSE
        async with CalibrationPage(self._args.host, self._args.port) as page:
            _say(
                f"http://{reachable(self._args.host)}:{page.port}/ shows the picture and what to do; so do these lines"
            )
            if not is_local(self._args.host):
                _say(f"anyone on this network can see it, at http://{own_address()}:{page.port}/")
            try:
                while not self.guide.done:
                    try:
                        if source is None:
                            source = await asyncio.to_thread(self._open)
                        frame = await asyncio.to_thread(source.read, READ_TIMEOUT)
                    except OSError as error:
                        if source is not None:
                            await asyncio.to_thread(source.close)
                            source = None
                        self._tell(f"{error}; trying again")
                        await page.show(self._state(Step(f"The camera is lost: {error}"), "trouble"), b"")
                        await asyncio.sleep(pause)
                        pause = min(2.0 * pause, LONGEST_PAUSE)
                        continue
                    if frame is None:
                        self._tell("the source has ended")
                        break
                    pause = FIRST_PAUSE
                    step = await asyncio.to_thread(self._see, frame.image)
                    picture = await asyncio.to_thread(self._picture, frame.image) if page.watched else b""
                    await page.show(self._state(step, "kept" if step.kept else "", frame.image), picture)
            finally:
                if source is not None:
                    # Also wakes the thread that waits for a frame.
                    source.close()
            status = _finish(self._args, self.guide.used, self.guide.calibration, "too few views")
            text = f"Done: {self._args.out} is written" if status == 0 else "Not good enough: see the terminal"
            await page.show(self._state(Step(text), "done" if status == 0 else "trouble", ended=True), b"")
        return status

    def _open(self) -> FrameSource:
        settings = CaptureSettings(width_px=self._args.width_px, height_px=self._args.height_px)
        return self._open_source(self._args.source, settings)

    def _see(self, image: Pixels) -> Step:
        """One picture, told on the terminal."""
        view = self._detector.find(image, f"view {len(self.guide.views) + 1}", thorough=False)
        step = self.guide.feed(view)
        now = time.monotonic()
        if view is not None:
            self._boardless, self._puzzle = now, ""
        elif now - self._boardless > _PUZZLED:
            self._boardless, self._puzzle = now, self._detector.what_is_there(image)
        if self._puzzle:
            step = Step(f"{step.text}: {self._puzzle}")
        if step.kept:
            met = sum(criterion.met for criterion in self.guide.criteria)
            self._tell(f"view {len(self.guide.views)} is taken, {met} of {len(self.guide.criteria)} conditions are met")
        self._tell(step.text)
        return step

    def _tell(self, text: str) -> None:
        """Once."""
        if text != self._said:
            self._said = text
            _say(text)

    def _picture(self, image: Pixels) -> bytes:
        now = time.monotonic()
        if now < self._next_picture:
            return b""
        self._next_picture = now + _PICTURE_INTERVAL
        picture = grey(image)
        scale = min(1.0, _PICTURE_PX / picture.shape[1])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()

    def _state(
        self, step: Step, state: str = "", image: Pixels | None = None, *, ended: bool = False
    ) -> dict[str, Any]:
        """For the page; places as parts of the picture."""
        size = (1.0, 1.0) if image is None else (image.shape[1], image.shape[0])
        return {
            "board": str(self.guide.board),
            "text": step.text,
            "state": state,
            "ended": ended,
            "views": len(self.guide.views),
            "cells": (coverage(self.guide.used) > 0).tolist(),
            "criteria": [{"met": c.met, "part": c.part, "text": c.text} for c in self.guide.criteria],
            "outline": None if step.outline_px is None else (step.outline_px / size).tolist(),
            "target": None if step.target_px is None else (step.target_px / size).tolist(),
        }


def _finish(args: argparse.Namespace, views: Sequence[BoardView], calibration: Calibration | None, trouble: str) -> int:
    """Judge, write and say. Returns the exit status."""
    criteria = judge(views if calibration is None else calibration.views, calibration)
    accepted = all(criterion.met for criterion in criteria)
    written = calibration is not None and (accepted or args.force)
    if calibration is not None and written:
        save_intrinsics(args.out, calibration.intrinsics, calibration.quality(accepted, datetime.date.today()))
    if args.json:
        content = _content(calibration, criteria, accepted, str(args.out) if written else None, trouble)
        sys.stdout.write(msgspec.json.encode(content).decode() + "\n")
    elif calibration is not None:
        sys.stdout.write(_text(calibration, criteria))
    sys.stdout.flush()
    if accepted:
        _say(f"{args.out} is written; now `steadfix floor` tells on the floor whether a tape measure agrees")
    elif written:
        _say(f"{args.out} is written because of --force, but positions from it may be wrong: see what is missing")
    else:
        _say(
            f"{args.out} is not written: "
            + (trouble or "what is missing above would make positions wrong; take those pictures, or --force it")
        )
    return 0 if written else 1


def _content(
    calibration: Calibration | None, criteria: Sequence[Criterion], accepted: bool, written: str | None, trouble: str
) -> dict[str, Any]:
    content: dict[str, Any] = {
        "accepted": accepted,
        "written": written,
        "criteria": [
            {"name": c.name, "met": c.met, "part": round(c.part, 3), "text": c.text, "advice": c.advice}
            for c in criteria
        ],
    }
    if calibration is None:
        return content | {"error": trouble}
    quality = calibration.quality(accepted, datetime.date.today())
    tilts = calibration.tilts_deg.tolist()
    return content | {
        "width_px": calibration.intrinsics.width_px,
        "height_px": calibration.intrinsics.height_px,
        "camera_matrix": calibration.intrinsics.camera_matrix.tolist(),
        "distortion": calibration.intrinsics.distortion.tolist(),
        "rms_px": calibration.rms_px,
        "quality": msgspec.to_builtins(quality),
        "views": [
            {"name": view.name, "corners": len(view.indices), "rms_px": round(rms, 4), "tilt_deg": round(tilt, 1)}
            for view, rms, tilt in zip(calibration.views, calibration.view_rms_px.tolist(), tilts, strict=True)
        ],
        "left_out": [view.name for view in calibration.left_out],
    }


def _text(calibration: Calibration, criteria: Sequence[Criterion]) -> str:
    """The same for people."""
    sigma = np.sqrt(np.diag(calibration.covariance))
    (fx, _, cx), (_, fy, cy), _ = calibration.intrinsics.camera_matrix.tolist()
    lines = [
        f"focal length   {fx:8.2f} {fy:8.2f} px, each +- {sigma[:2].max():.2f}",
        f"middle         {cx:8.2f} {cy:8.2f} px, each +- {sigma[2:4].max():.2f}",
        f"corners fit to {calibration.rms_px:8.3f} px; {calibration.held_back_rms_px:.3f} px in views held back",
    ]
    lines += [f"left out       {view.name}: it does not fit to the others" for view in calibration.left_out]
    for criterion in criteria:
        advice = f": {criterion.advice}" if criterion.advice else ""
        lines.append(f"{'good' if criterion.met else 'MISSING':<8} {criterion.text}{advice}")
    return "\n".join(lines) + "\n"


def _say(text: str) -> None:
    sys.stderr.write(f"steadfix calibrate: {text}\n")


def _fail(text: str, status: int) -> int:
    _say(text)
    return status
