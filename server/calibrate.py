"""`steadfix calibrate`: a camera's focal length and distortion, from pictures of a board: live or from files."""

from __future__ import annotations

import argparse
import datetime
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from camera.boards import DEFAULT_BOARD, BoardDetector, BoardView, parse_board
from camera.calibration import Calibration, CalibrationError, Criterion, calibrate, judge, save_intrinsics
from camera.capture import IMAGE_SUFFIXES, read_image


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("images", nargs="*", metavar="IMAGE", help="pictures of the board, or folders of them")
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


def run(args: argparse.Namespace) -> int:
    """Runs the command. Returns 0 if the calibration was written; 1 if it was refused, or a picture could not be read;
    2 for arguments that cannot be followed."""
    board = parse_board(args.board)
    if not args.images:
        return _fail("name pictures of the board, or --source for a live camera", 2)
    if args.out.is_dir() or not args.out.absolute().parent.is_dir():
        return _fail(f"--out {args.out}: a file in a folder that is there is needed", 2)
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
    _say(f"the board is in {len(views)} of {count} pictures")
    return views, failed


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
        _say(f"{args.out} is written")
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
