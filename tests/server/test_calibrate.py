"""`steadfix calibrate`: from photographs, from rendered pictures, and live with its page in a real browser."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import pytest
from playwright.async_api import Page, async_playwright

from camera.boards import parse_board
from camera.calibration import load_intrinsics
from camera.capture import Frame
from camera.settings import CaptureSettings
from fusion.measurements import Array
from server import calibrate
from server.calibration_page import CalibrationPage
from tests.camera.board_views import CAMERA, Studio, good_poses
from tests.data import data
from tests.server.command import steadfix
from tests.server.room import run
from tests.server.test_page import CHROMIUM, FLAGS, see

ROOT = Path(__file__).parents[2]
BOARD = "charuco:8x6:30mm"


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio(parse_board(BOARD))


def enough(studio: Studio) -> list[Array]:
    """28 poses of the board that are accepted."""
    return good_poses(studio) + [studio.held((x, y), 0.33) for x in (0.1, 0.9) for y in (0.1, 0.9)]


@pytest.fixture(scope="module")
def pictures(studio: Studio, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with pictures that are enough."""
    folder = tmp_path_factory.mktemp("pictures")
    for k, pose in enumerate(enough(studio)):
        cv2.imwrite(str(folder / f"{k:02}.png"), studio.picture(pose))
    return folder


def test_pictures_that_are_enough(capfd: pytest.CaptureFixture[str], pictures: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.toml"
    status, text, err = steadfix(capfd, "calibrate", pictures, "--out", out)
    assert status == 0
    assert err.splitlines() == [
        "steadfix calibrate: the board is in 28 of 28 pictures",
        f"steadfix calibrate: {out} is written; now `steadfix floor` tells on the floor whether a tape measure agrees",
    ]
    assert "MISSING" not in text
    np.testing.assert_allclose(load_intrinsics(out).camera_matrix, CAMERA.camera_matrix, atol=1.5)
    # The service takes it for this image size alone.
    load_intrinsics(out).check_size(640, 480)


def test_photographs(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = data("chessboard_photos")
    out = tmp_path / "camera.toml"
    arguments = (*sorted(folder.glob("*.jpg")), "--board", "chessboard:9x6:25mm", "--out", out, "--json")
    status, text, err = steadfix(capfd, "calibrate", *arguments)
    content = json.loads(text)
    assert (status, content["accepted"], content["written"]) == (1, False, None)
    assert content["rms_px"] <= 0.20
    assert content["camera_matrix"][0][0] == pytest.approx(532.83, rel=3e-3)
    assert {c["name"] for c in content["criteria"] if not c["met"]} == {"views", "coverage", "corners", "projection"}
    assert not out.exists()
    assert f"{out} is not written: what is missing" in err
    status, text, err = steadfix(capfd, "calibrate", *arguments, "--force")
    assert (status, json.loads(text)["written"]) == (0, str(out))
    assert "because of --force" in err
    assert "accepted = false" in out.read_text()


def test_eight_frontal_pictures_are_refused(capfd: pytest.CaptureFixture[str], studio: Studio, tmp_path: Path) -> None:
    for k in range(8):
        pose = studio.held((0.3 + 0.13 * (k % 4), 0.4 + 0.2 * (k // 4)), 0.45)
        cv2.imwrite(str(tmp_path / f"{k}.png"), studio.picture(pose))
    status, text, err = steadfix(capfd, "calibrate", tmp_path, "--out", tmp_path / "camera.toml")
    assert status == 1
    assert "MISSING  8 views of the board: take 12 more" in text
    assert "MISSING  0 views tilted by 20 to 45 deg: tilt the board by about 30 deg" in text
    assert "is not written" in err
    assert not (tmp_path / "camera.toml").exists()


def test_pictures_that_are_none_are_named_and_the_others_used(
    capfd: pytest.CaptureFixture[str], pictures: Path, studio: Studio, tmp_path: Path
) -> None:
    (tmp_path / "text.png").write_text("no image")
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((480, 640), np.uint8))
    deep = 257 * studio.picture(good_poses(studio)[0]).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), np.dstack([deep] * 4))
    status, _, err = steadfix(
        capfd, "calibrate", pictures, pictures / "03.png", tmp_path / "text.png", tmp_path / "black.png",
        tmp_path / "gone.png", tmp_path / "deep.png", "--out", tmp_path / "camera.toml",
    )  # fmt: skip
    # The calibration is good and written; that a picture could not be read is still to be seen from the status.
    assert status == 1
    assert (tmp_path / "camera.toml").exists()
    for words in (
        "03.png: left out, the board is where it is in 03.png",
        "text.png: not an image that can be read",
        "black.png: no charuco:8x6:30mm: the picture is blank",
        "gone.png: No such file or directory",
        "deep.png: left out, the board is where it is in 00.png",
        "the board is in 28 of 33 pictures",
    ):
        assert words in err


def test_another_image_size_and_another_board(
    capfd: pytest.CaptureFixture[str], pictures: Path, tmp_path: Path
) -> None:
    large = cv2.resize(cv2.imread(str(pictures / "05.png")), None, fx=2.0, fy=2.0)
    cv2.imwrite(str(tmp_path / "large.png"), large)
    out = tmp_path / "camera.toml"
    status, text, err = steadfix(capfd, "calibrate", pictures, tmp_path / "large.png", "--out", out)
    assert (status, text) == (1, "")
    assert "large.png is 1280 x 960 px, 00.png 640 x 480 px: all pictures must come from one camera" in err
    status, text, err = steadfix(
        capfd, "calibrate", pictures / "00.png", "--board", "charuco:8x6:30mm:21mm:4X4_50", "--out", out
    )
    assert (status, text) == (1, "")
    assert "it shows markers of 5X5_250" in err
    assert "too few views of the board: 0, and at least 4 are needed" in err
    assert not out.exists()


def test_arguments_that_cannot_be_followed(capfd: pytest.CaptureFixture[str], pictures: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "camera.toml")
    for arguments, status, says in (
        (out, 2, "name pictures of the board, or --source"),
        ((pictures, "--source", "0", *out), 2, "name pictures of the board, or --source"),
        ((pictures, "--out", tmp_path), 2, "a file in a folder that is there is needed"),
        ((pictures, "--out", tmp_path / "no" / "camera.toml"), 2, "a file in a folder that is there is needed"),
        ((pictures, "--board", "9x6", *out), 2, "'9x6' is no board; chessboard:9x6:25mm"),
        (("--source", tmp_path / "none.mp4", *out), 1, "none.mp4: no such video file, folder of images or camera"),
    ):
        found, _, err = steadfix(capfd, "calibrate", *arguments)
        assert found == status, arguments
        assert says in err
        assert err.count("\n") == 1


@pytest.fixture(scope="module")
def film(studio: Studio, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a camera: each place of the board for two pictures."""
    folder = tmp_path_factory.mktemp("film")
    for k, pose in enumerate(enough(studio)):
        for n in range(2):
            cv2.imwrite(str(folder / f"{k:02}-{n}.png"), studio.picture(pose))
    return folder


def test_a_guided_calibration_ends_when_it_is_good(
    capfd: pytest.CaptureFixture[str], film: Path, tmp_path: Path
) -> None:
    out = tmp_path / "camera.toml"
    status, text, err = steadfix(capfd, "calibrate", "--source", film, "--out", out, "--port", 0)
    assert status == 0
    lines = [line.removeprefix("steadfix calibrate: ") for line in err.splitlines()]
    assert re.match(r"http://127\.0\.0\.1:\d+/ shows the picture", lines[0])
    assert next(line for line in lines if line.startswith("view ")) == "view 1 is taken, 0 of 8 conditions are met"
    assert any(line.startswith("Tilt the board: its ") for line in lines)
    assert lines[-2] == "Done"
    assert lines[-1].startswith(f"{out} is written")
    assert "MISSING" not in text
    np.testing.assert_allclose(load_intrinsics(out).camera_matrix, CAMERA.camera_matrix, atol=2.0)


def test_a_source_that_ends_too_early_is_judged(capfd: pytest.CaptureFixture[str], film: Path, tmp_path: Path) -> None:
    for path in sorted(film.iterdir())[:12]:
        (tmp_path / path.name).symlink_to(path)
    status, text, err = steadfix(
        capfd, "calibrate", "--source", tmp_path, "--out", tmp_path / "camera.toml", "--port", 0, "--json"
    )
    assert status == 1
    assert "the source has ended" in err
    assert json.loads(text)["written"] is None
    assert not (tmp_path / "camera.toml").exists()


class Wobbly:
    """A camera that is unplugged after the fourth picture, and cannot be opened at the first try after that."""

    def __init__(self, pictures: list[np.ndarray]) -> None:
        self.opened = self.closed = 0
        self._pictures = pictures
        self._read = 0

    def open(self, source: str, settings: CaptureSettings) -> Wobbly:
        assert settings == CaptureSettings(width_px=640)
        self.opened += 1
        if self.opened == 2:
            raise FileNotFoundError("camera 0: not there")
        return self

    def read(self, timeout: float) -> Frame | None:
        self._read += 1
        if self._read == 5:
            raise OSError("camera 0: lost; it no longer delivers frames")
        return Frame(0.0, self._pictures.pop(0)) if self._pictures else None

    def close(self) -> None:
        self.closed += 1


def test_a_camera_that_is_unplugged_and_plugged_in_again_goes_on(
    capfd: pytest.CaptureFixture[str], film: Path, tmp_path: Path
) -> None:
    wobbly = Wobbly([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(film.iterdir())[:10]])
    parser = argparse.ArgumentParser()
    calibrate.add_arguments(parser)
    options = ["--source", "0", "--width-px", "640", "--port", "0", "--out", str(tmp_path / "camera.toml")]
    guided = calibrate.Guided(parser.parse_args(options), parse_board(BOARD), wobbly.open)
    assert asyncio.run(guided.run()) == 1
    err = capfd.readouterr().err
    assert "camera 0: lost; it no longer delivers frames; trying again" in err
    assert "camera 0: not there; trying again" in err
    assert (wobbly.opened, wobbly.closed) == (3, 2)
    # Two of the five places before it was lost, three after.
    assert len(guided.guide.views) == 5


class Session:
    """The command in a process of its own, on a camera that never ends."""

    def __init__(self, folder: Path, out: Path, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "server.cli", "calibrate", "--source", str(folder), "--out", str(out)]
            + ["--port", "0", *arguments],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.lines: list[str] = []
        self._news = threading.Condition()
        assert self.process.stderr is not None
        self._reader = threading.Thread(target=self._read, args=(self.process.stderr,))
        self._reader.start()

    def _read(self, stream: IO[str]) -> None:
        for line in stream:
            with self._news:
                self.lines.append(line.removeprefix("steadfix calibrate: ").rstrip())
                self._news.notify_all()

    def wait_for(self, words: str) -> str:
        def found() -> str | None:
            return next((line for line in self.lines if words in line), None)

        with self._news:
            assert self._news.wait_for(found, 60.0), self.lines
            line = found()
            assert line is not None
            return line

    def end(self) -> int:
        status = self.process.wait(60.0)
        self._reader.join(60.0)
        return status


@contextlib.contextmanager
def session(folder: Path, out: Path, *arguments: str) -> Iterator[Session]:
    running = Session(folder, out, *arguments)
    try:
        yield running
    finally:
        running.process.kill()
        running.process.wait()
        running._reader.join(60.0)
        assert running.process.stdout is not None
        running.process.stdout.close()
        assert running.process.stderr is not None
        running.process.stderr.close()


@pytest.mark.parametrize("forced", [False, True])
def test_ctrl_c_writes_what_is_there_only_if_forced(film: Path, tmp_path: Path, forced: bool) -> None:
    out = tmp_path / "camera.toml"
    with session(film, out, *(["--force"] if forced else [])) as running:
        running.wait_for("view 6 is taken")
        running.process.send_signal(signal.SIGINT)
        status = running.end()
        assert not any("Traceback" in line for line in running.lines)
        assert out.exists() == forced
        if forced:
            assert status == 0
            assert "because of --force" in running.lines[-1]
        else:
            assert status == 130
            assert re.fullmatch(rf"stopped with \d+ views: {re.escape(str(out))} is not written", running.lines[-1])


def test_the_page_shows_what_to_do_and_the_end(film: Path, tmp_path: Path) -> None:
    if not CHROMIUM.exists():
        pytest.skip(f"{CHROMIUM} is not installed")
    # The camera's first picture is a pipe, so that it waits until the browser is there.
    folder = tmp_path / "slow"
    folder.mkdir()
    pipe = folder / "000.png"
    os.mkfifo(pipe)
    for path in sorted(film.iterdir()):
        (folder / path.name).with_name(f"1{path.name}").symlink_to(path)
    out = tmp_path / "camera.toml"

    async def main() -> None:
        complaints: list[str] = []
        async with async_playwright() as playwright:
            chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            with session(folder, out) as running:
                try:
                    page: Page = await chromium.new_page(viewport={"width": 1280, "height": 800})
                    page.on("pageerror", lambda error: complaints.append(str(error)))
                    page.on("console", lambda message: complaints.append(message.text))
                    address = await asyncio.to_thread(running.wait_for, "http://")
                    await page.goto(address.split()[0])
                    await page.evaluate(WATCH)
                    # Now the camera may begin: what comes out of the pipe is no picture, and is passed over.
                    await asyncio.to_thread(lambda: pipe.open("wb").close())
                    await see(page, "document.querySelectorAll('#criteria li').length === 8")
                    await see(page, "document.getElementById('picture').width === 640")
                    assert await page.inner_text("#board") == BOARD
                    await see(page, f"({BLUE}) > 300")  # the outline of the board
                    await see(page, "document.getElementById('what').className === 'done'")
                    assert await page.inner_text("#what") == f"Done: {out} is written"
                    await see(page, "document.querySelectorAll('#criteria li.met').length === 8")
                    assert int(await page.inner_text("#views")) >= 20
                    told = await page.evaluate("told")
                    for words in ("Hold it still", "Tilt the board", "Move the board"):
                        assert any(text.startswith(words) for text in told), told
                    assert await asyncio.to_thread(running.end) == 0
                finally:
                    await chromium.close()
        assert complaints == []

    run(main)


WATCH = """(() => {
    window.told = [];
    const what = document.getElementById("what");
    new MutationObserver(() => told.push(what.textContent)).observe(what, { childList: true, characterData: true });
})()"""
BLUE = """(() => {
    const canvas = document.getElementById("picture");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    // #3b82f6
    for (let i = 0; i < data.length; i += 4) count += data[i] < 90 && data[i + 1] < 160 && data[i + 2] > 220;
    return count;
})()"""


def test_the_page_is_not_held_up_by_a_viewer_that_takes_nothing() -> None:
    async def main() -> None:
        async with CalibrationPage("127.0.0.1", 0) as page:
            reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
            writer.write(
                b"GET /v1/calibration HTTP/1.1\r\nHost: here\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
            )
            assert (await reader.readline()).startswith(b"HTTP/1.1 101")
            while not page.watched:
                await asyncio.sleep(0)
            reader._transport.pause_reading()  # type: ignore[attr-defined]
            picture = bytes(100_000)
            for k in range(300):  # 30 MB, more than any socket holds
                await page.show({"k": k}, picture)
                await asyncio.sleep(0)
            writer.transport.abort()

    run(main)


def test_what_the_page_does_not_have(studio: Studio) -> None:
    async def main() -> None:
        async with CalibrationPage("127.0.0.1", 0) as page:
            for path, expected in (
                ("/", b"200"), ("/calibrate.js", b"200"), ("/calibrate.css", b"200"), ("/dashboard.css", b"200"),
                ("/../config.py", b"404"), ("/v1/calibration", b"404"),
            ):  # fmt: skip
                reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
                writer.write(f"GET {path} HTTP/1.1\r\nHost: here\r\n\r\n".encode())
                assert (await reader.readline()).split()[1] == expected, path
                writer.close()
                await writer.wait_closed()

    run(main)
