import logging
import random
import threading
import time

import cv2
import numpy as np
import pytest

from camera import capture
from camera.capture import FileSource, Frame, LiveSource, V4l2Device, open_source, read_image, without_password
from camera.settings import CaptureSettings
from tests.camera.rtsp import NetworkCamera

WAIT = 20.0


def write_video(path, count=12, rate=25.0):
    """A real encoded file; the frame's number is its brightness."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate, (64, 48))
    assert writer.isOpened()
    for k in range(count):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()
    return path


def numbers(source):
    """Reads a source to its end."""
    frames = []
    while (frame := source.read(WAIT)) is not None:
        frames.append(frame)
    assert source.read(WAIT) is None
    return frames


def test_a_video_file_comes_in_order_with_stamps_at_its_own_rate(tmp_path):
    source = open_source(str(write_video(tmp_path / "room.avi")), paced=False)
    begin = time.monotonic()
    frames = numbers(source)
    source.close()
    assert [round(frame.image.mean() / 20) for frame in frames] == list(range(12))
    assert [frame.sequence for frame in frames] == list(range(1, 13))
    np.testing.assert_allclose(np.diff([frame.t for frame in frames]), 0.04, atol=1e-9)
    assert begin <= frames[0].t <= time.monotonic()
    assert frames[0].image.shape == (48, 64, 3)


def test_a_paced_file_is_never_early_and_its_stamps_never_lag(tmp_path):
    source = open_source(str(write_video(tmp_path / "room.avi", 6, 50.0)))
    for _ in range(6):
        frame = source.read(WAIT)
        assert time.monotonic() >= frame.t
    # A reader that is slower than the file: half a second behind is more than one interval.
    source = FileSource(iter([np.zeros((2, 2), np.uint8)] * 3), rate_hz=1000.0, paced=True)
    first = source.read(WAIT)
    while time.monotonic() < first.t + 0.05:
        pass
    assert source.read(WAIT).t > first.t + 0.04


def test_closing_ends_a_reader_that_waits_for_a_slow_file():
    source = FileSource(iter([np.zeros((2, 2), np.uint8)] * 2), rate_hz=0.001, paced=True)
    assert source.read(WAIT) is not None
    results = []
    reader = threading.Thread(target=lambda: results.append(source.read(WAIT)))
    reader.start()
    source.close()
    reader.join(WAIT)
    assert results == [None]


def test_a_folder_comes_by_name_and_leaves_out_what_is_no_image(tmp_path, caplog):
    for name, grey in (("c.png", 30), ("a.PNG", 10), ("d.jpg", 40)):
        cv2.imwrite(str(tmp_path / name), np.full((4, 4), grey, np.uint8))
    (tmp_path / "b.png").write_bytes((tmp_path / "c.png").read_bytes()[:40])
    (tmp_path / "notes.txt").write_text("not an image")
    with caplog.at_level(logging.WARNING):
        frames = numbers(open_source(str(tmp_path), CaptureSettings(frame_rate_hz=5.0), paced=False))
    assert [round(frame.image.mean() / 10) for frame in frames] == [1, 3, 4]
    np.testing.assert_allclose(np.diff([frame.t for frame in frames]), 0.2, atol=1e-9)
    assert "b.png: not an image that can be read; skipped" in caplog.text


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("/dev/video987", "camera /dev/video987: not there; cameras found: "),
        (987, "camera /dev/video987: not there"),
        ("987", "camera /dev/video987: not there"),
        ("rtsp://127.0.0.1:1/stream", "camera rtsp://127.0.0.1:1/stream: no answer within 5 s"),
        ("nowhere.mp4", "nowhere.mp4: no such video file, folder of images or camera"),
        ("text.mp4", "text.mp4: not a video file that can be read"),
        ("empty", "empty: no image in this folder"),
        ("picamera", "apt install python3-picamera2"),
    ],
)
def test_a_source_that_is_not_there_is_said_in_one_line(tmp_path, monkeypatch, capfd, source, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.mp4").write_text("no video\n" * 100)
    (tmp_path / "empty").mkdir()
    with pytest.raises(OSError, match=r"^[^\n]*$") as caught:
        open_source(source)
    assert says in str(caught.value)
    assert capfd.readouterr().err == ""


class Scripted:
    """A device whose frames are handed to it by the test."""

    def __init__(self):
        self.frames = []
        self.ready = threading.Semaphore(0)
        self.taken = threading.Semaphore(0)
        self.closed = threading.Event()

    def push(self, frame):
        self.frames.append(frame)
        self.ready.release()

    def grab(self):
        self.taken.release()
        if not self.ready.acquire(timeout=WAIT):
            raise OSError("the test forgot it")
        frame = self.frames.pop(0)
        if isinstance(frame, OSError):
            raise frame
        return Frame(frame, np.full((2, 2), frame, np.uint8))

    def close(self):
        self.closed.set()


def test_a_live_source_hands_out_the_newest_frame_only():
    device = Scripted()
    source = LiveSource("scripted", device)
    for t in (1.0, 2.0, 3.0):
        device.push(t)
    for _ in range(4):  # the fourth call says that the third frame has been put away
        assert device.taken.acquire(timeout=WAIT)
    frame = source.read(WAIT)
    assert (frame.t, frame.sequence, frame.image[0, 0]) == (3.0, 3, 3)
    with pytest.raises(TimeoutError, match=r"camera scripted: no frame for 0.01 s"):
        source.read(0.01)
    device.push(4.0)
    assert source.read(WAIT).sequence == 4
    device.push(OSError("camera scripted: lost"))
    with pytest.raises(OSError, match="camera scripted: lost"):
        source.read(WAIT)
    source.close()
    assert device.closed.is_set()


def test_closing_a_live_source_frees_its_reader_and_its_device():
    device = Scripted()
    source = LiveSource("scripted", device)
    results = []
    reader = threading.Thread(target=lambda: results.append(source.read(WAIT)))
    reader.start()
    closer = threading.Thread(target=source.close)
    closer.start()
    reader.join(WAIT)
    assert results == [None]
    device.push(5.0)
    closer.join(WAIT)
    assert device.closed.is_set()
    assert not closer.is_alive()


def test_image_files_of_every_depth_and_none(tmp_path, capfd):
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    for name, image in (
        ("grey.png", grey),
        ("colour.png", np.dstack([grey] * 3)),
        ("alpha.png", np.dstack([grey] * 4)),
        ("deep.png", grey.astype(np.uint16) * 1000),
    ):
        cv2.imwrite(str(tmp_path / name), image)
    assert read_image(tmp_path / "grey.png").shape == (6, 8)
    assert read_image(tmp_path / "colour.png").shape == (6, 8, 3)
    assert read_image(tmp_path / "alpha.png").shape == (6, 8, 3)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), grey.astype(np.uint16) * 1000)
    (tmp_path / "cut.png").write_bytes((tmp_path / "deep.png").read_bytes()[:60])
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("hello")
    for name in ("cut.png", "empty.png", "text.png"):
        with pytest.raises(OSError, match=f"{name}: not an image that can be read"):
            read_image(tmp_path / name)
    with pytest.raises(OSError, match=r"missing.png: No such file"):
        read_image(tmp_path / "missing.png")
    with pytest.raises(OSError, match="Is a directory"):
        read_image(tmp_path)
    assert capfd.readouterr().err == ""


def test_silence_is_lifted_again(capfd):
    with pytest.raises(KeyError), capture._stderr_silenced():
        raise KeyError
    import os

    os.write(2, b"heard\n")
    assert capfd.readouterr().err == "heard\n"


class Webcam:
    """OpenCV's VideoCapture over a USB camera, as far as the driver's side of it is known. Numbers by property."""

    def __init__(self, age=0.02, refuses=()):
        self.age, self.refuses = age, refuses
        self.set_in_order = []
        self.values = {cv2.CAP_PROP_EXPOSURE: 157.0, cv2.CAP_PROP_GAIN: 64.0}
        self.there = True

    def __call__(self, source, backend):
        self.opened = source, backend
        return self

    def isOpened(self):
        return True

    def set(self, what, value):
        self.set_in_order.append(what)
        if what in self.refuses:
            return False
        self.values[what] = value
        return True

    def get(self, what):
        if what == cv2.CAP_PROP_POS_MSEC:
            return 1e3 * (time.monotonic() - self.age)
        return self.values.get(what, 0.0)

    def grab(self):
        return self.there

    def retrieve(self):
        return True, np.zeros((48, 64, 3), np.uint8)

    def release(self):
        self.there = False


def test_a_usb_camera_is_set_up_and_stamps_mid_exposure(monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    webcam = Webcam()
    monkeypatch.setattr(cv2, "VideoCapture", webcam)
    camera = V4l2Device(
        0,
        CaptureSettings(
            width_px=640, height_px=480, frame_rate_hz=30.0, pixel_format="MJPG", exposure_ms=4.0, gain=20.0
        ),
    )
    assert webcam.set_in_order == [
        cv2.CAP_PROP_FOURCC,
        cv2.CAP_PROP_FRAME_WIDTH,
        cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS,
        cv2.CAP_PROP_AUTO_EXPOSURE,
        cv2.CAP_PROP_EXPOSURE,
        cv2.CAP_PROP_GAIN,
    ]
    assert webcam.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1.0
    assert webcam.values[cv2.CAP_PROP_EXPOSURE] == 40.0, "in units of 0.1 ms"
    begin = time.monotonic()
    frame = camera.grab()
    assert frame.exposure == 0.004
    # The driver stamped the start of the exposure.
    assert begin - 0.02 + 0.002 <= frame.t <= time.monotonic() - 0.02 + 0.002
    camera.grab()
    (record,) = caplog.records
    assert record.getMessage() == "camera 0: frames are stamped by the driver, on the monotonic clock"
    webcam.there = False
    with pytest.raises(OSError, match="camera 0: lost; it no longer delivers frames"):
        camera.grab()


def test_a_usb_camera_that_does_not_take_its_exposure_says_so(monkeypatch, caplog):
    monkeypatch.setattr(cv2, "VideoCapture", Webcam(age=1000.0, refuses=(cv2.CAP_PROP_EXPOSURE,)))
    camera = V4l2Device(0, CaptureSettings(exposure_ms=4.0))
    (record,) = caplog.records
    assert record.getMessage() == "camera 0: exposure_ms = 4 was asked for, it says 15.7"
    begin = time.monotonic()
    frame = camera.grab()
    assert np.isnan(frame.exposure)
    assert begin <= frame.t <= time.monotonic(), "a stamp that fits no clock is not believed"


def test_a_usb_camera_is_left_alone_where_nothing_is_asked(monkeypatch):
    webcam = Webcam()
    monkeypatch.setattr(cv2, "VideoCapture", webcam)
    V4l2Device("/dev/null")
    assert webcam.set_in_order == []
    assert webcam.opened == ("/dev/null", cv2.CAP_V4L2)


def test_a_network_camera_is_stamped_by_its_own_clock_and_missed_when_it_hangs_up():
    """A real RTSP stream, whose frames leave the camera up to 80 ms after they were taken."""
    begin = time.monotonic()
    chance = random.Random(1)

    def due(k):
        time.sleep(max(0.0, begin + 0.1 * k + chance.choice((0.0, 0.08)) - time.monotonic()))  # the camera's pace

    camera = NetworkCamera(lambda k: np.full((48, 64, 3), 10 + k, np.uint8), lambda k: 500.0 + 0.1 * k, due)
    try:
        source = open_source(camera.url)
        frames = [source.read(WAIT) for _ in range(12)]
        late = [frame.t - begin - 0.1 * round(float(frame.image.mean()) - 10) for frame in frames]
        # By what the promptest took, and by nothing of what each took.
        assert min(late) >= 0.0
        assert np.diff(late).max() < 1e-3
        camera.hang_up()
        with pytest.raises(OSError, match=r"camera rtsp://127.0.0.1:\d+/stream: lost; it no longer delivers frames"):
            numbers(source)
        source.close()
        # It is there again.
        again = open_source(camera.url)
        assert again.read(WAIT) is not None
        again.close()
    finally:
        camera.close()


def test_passwords_are_not_shown():
    assert without_password("rtsp://admin:secret@10.0.0.5:554/h264?x=a:b@c") == (
        "rtsp://admin:***@10.0.0.5:554/h264?x=a:b@c"
    )
    assert without_password("rtsp://10.0.0.5/h264") == "rtsp://10.0.0.5/h264"
    with pytest.raises(OSError, match=r"^camera rtsp://me:\*\*\*@127\.0\.0\.1:1/s: no answer"):
        open_source("rtsp://me:secret@127.0.0.1:1/s")
