"""`steadfix camera`: the node of a remote camera. It captures and finds markers here, the service does the rest.

What it sees is sent as it is seen: where the link is slower, or away, the newest frame replaces the one that waits, and
nothing queues up. It connects again whenever the connection is lost, and opens its camera again whenever that is.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import math
import os
import socket
import ssl
import time
from collections.abc import Callable
from functools import partial
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed, WebSocketException

from camera.capture import Frame, FrameSource, open_source
from camera.exposure import DeliveryMeter, black
from camera.tracking import MarkerTracker
from server.camera_messages import (
    CameraHello,
    CameraWelcome,
    FrameSeen,
    MarkerSeen,
    MarkerSizes,
    NodeStatus,
    encode,
    to_node,
)
from server.connecting import FIRST_PAUSE, LONGEST_PAUSE, connect_to_service, longer
from server.frames import FrameThread
from server.messages import ClockAnswer, ClockQuestion, Error, MessageError, Notice
from server.terminal import log_to_stderr, until_stopped

log = logging.getLogger("steadfix.camera")

# s until the service must have answered the hello.
HELLO_TIMEOUT = 10.0
STATUS_EVERY = 1.0
# Bytes that may wait in the kernel: what does not leave is to be replaced by what is newer.
UNSENT = 2 * 1024

Open = Callable[[CameraWelcome], FrameSource]


class NodeError(ValueError):
    """The node cannot do its work; the text says why, and what would be right."""


class Watch:
    """A camera that is opened as the welcome says, again whenever it is lost, and the markers in each of its frames.

    `seen` gets what each frame showed, in a thread; `ended` is called there when a file is at its end. `trouble`
    says in words what keeps it from its work, "" for nothing. Raises NodeError for a welcome that cannot be followed.
    """

    def __init__(
        self, welcome: CameraWelcome, open: Open, seen: Callable[[FrameSeen], None], ended: Callable[[], None]
    ) -> None:
        self.welcome = welcome
        self.trouble = "the camera is being opened"
        self.meter = DeliveryMeter()
        self._seen = seen
        try:
            self._tracker = MarkerTracker(welcome.dictionary, welcome.ids, welcome.still)
        except ValueError as error:
            raise NodeError(f"the service's welcome: {error}") from None
        self._thread = FrameThread(
            "camera", lambda: open(welcome), self._look, self._lost, ended, (FIRST_PAUSE, LONGEST_PAUSE)
        )
        self._thread.start()

    def sizes_px(self, shortest_px: float, longest_px: float) -> None:
        """How long the markers' sides are, which makes searching for them cheaper."""
        self._tracker.sides_px = shortest_px, longest_px

    def stop(self) -> None:
        """End the thread, and wait a moment for it to let go of the camera."""
        self._thread.stop()
        self._thread.join(1.0)

    def _lost(self, trouble: str) -> None:
        if trouble != self.trouble:
            log.warning("%s; trying again until it works", trouble)
        self.trouble = trouble

    def _look(self, frame: Frame) -> None:
        start = time.monotonic()
        self.meter.add(frame, start)
        sightings = self._tracker.track(frame.image, frame.t, line_time=frame.line_time)
        if self.trouble:
            log.info("frames are coming, %d x %d px", frame.image.shape[1], frame.image.shape[0])
            self.trouble = ""
        markers = [MarkerSeen(s.id, s.t, s.corners_px.tolist(), s.sigma_px, _known(s.blur_px)) for s in sightings]
        height_px, width_px = frame.image.shape[:2]
        detect_ms = 1e3 * (time.monotonic() - start)
        repeated = sorted(self._tracker.repeated)
        # When it is sent is to be seen.
        self._seen(FrameSeen(frame.t, frame.t, frame.sequence, width_px, height_px, detect_ms, markers, repeated))


class Node:
    """The connection, and what is to go over it. `run` is the whole of it.

    `url`: of the service, without a path; wss:// where it has a certificate, and `certificate` is the path of that one
    or of who has signed it, where nobody known has. `open`: how to open the camera that the welcome describes; its
    frames are stamped by `clock`. `dropped`: frames that were not sent.

    Raises NodeError for an address that is none and a certificate that cannot be read.
    """

    def __init__(
        self,
        url: str,
        name: str,
        open: Open,
        token: str = "",
        certificate: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("ws", "wss") or not parts.netloc:
            raise NodeError(f"--server {url}: an address such as ws://192.168.1.10:5678 is needed")
        self._url = url.rstrip("/") + "/v1/camera"
        self._name = name
        self._token = token
        try:
            self._tls = ssl.create_default_context(cafile=certificate) if parts.scheme == "wss" else None
        except OSError as error:
            raise NodeError(f"--certificate {certificate}: {error.strerror or error}") from None
        self._open = open
        self._clock = clock
        self.dropped = 0
        self._watch: Watch | None = None
        self._latest: FrameSeen | None = None
        self._news = asyncio.Event()
        self._ended = asyncio.Event()
        self._loop = asyncio.get_running_loop()

    async def run(self) -> None:
        """Until the source has ended, which a camera never does. Raises NodeError with the service's reason where it
        refuses this camera for good."""
        try:
            await self._connect_again_and_again()
        finally:
            if self._watch is not None:
                await asyncio.to_thread(self._watch.stop)

    async def _connect_again_and_again(self) -> None:
        pause, trouble = FIRST_PAUSE, ""
        while not self._ended.is_set():
            welcomed = False
            try:
                async with connect_to_service(self._url, self._tls) as connection:
                    await self._begin(connection)
                    welcomed = True
                    log.info("connected to %s as camera %s", self._url, self._name)
                    await self._talk(connection)
                reason = "the service has ended it"
            except ConnectionClosed as error:
                reason = (error.rcvd and error.rcvd.reason) or "it was lost"
            except ssl.SSLCertVerificationError as error:
                raise NodeError(
                    f"{self._url}: nobody known vouches for its certificate ({error.verify_message}); --certificate "
                    "names one that is to be believed"
                ) from None
            except (OSError, WebSocketException, MessageError) as error:
                reason = getattr(error, "strerror", None) or str(error) or "no answer"
            if self._ended.is_set():
                break
            if welcomed:
                pause, trouble = FIRST_PAUSE, ""
            if reason != trouble:
                log.warning("no connection to %s: %s; trying again until it works", self._url, reason)
            trouble = reason
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._ended.wait()
            pause = longer(pause)

    async def _begin(self, connection: ClientConnection) -> None:
        """Hello and welcome; the camera is opened if it is not, or with other settings than now wanted."""
        # What is not taken by the network yet waits where newer can replace it.
        connection.transport.set_write_buffer_limits(high=0)
        sock = connection.transport.get_extra_info("socket")
        if sock is not None and hasattr(socket, "TCP_NOTSENT_LOWAT"):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
        await connection.send(encode(CameraHello(self._name, self._token)), text=True)
        try:
            async with asyncio.timeout(HELLO_TIMEOUT):
                welcome = to_node(await connection.recv())
        except TimeoutError:
            raise TimeoutError(f"no welcome within {HELLO_TIMEOUT:.0f} s") from None
        if isinstance(welcome, Error):
            # A node that was welcome before, too: the service may be about to have its configuration put right.
            if welcome.retry or self._watch is not None:
                raise ConnectionRefusedError(f"refused: {welcome.reason}")
            raise NodeError(f"the service refuses camera {self._name}: {welcome.reason}")
        if not isinstance(welcome, CameraWelcome):
            raise MessageError("a first message that is no welcome")
        if self._watch is not None and self._watch.welcome != welcome:
            log.info("the service's configuration of this camera has changed")
            await asyncio.to_thread(self._watch.stop)
            self._watch = None
        if self._watch is None:
            self._watch = Watch(welcome, self._open, self._see, self._end)
        # Nobody needs what was seen before.
        self._latest = None

    async def _talk(self, connection: ClientConnection) -> None:
        """Send and receive, until the connection or the source is at its end."""
        works = [
            asyncio.create_task(work)
            for work in (self._send(connection), self._report(connection), self._hear(connection))
        ]
        try:
            done, _ = await asyncio.wait(works, return_when=asyncio.FIRST_COMPLETED)
            for work in done:
                work.result()
        finally:
            for work in works:
                work.cancel()
            await asyncio.gather(*works, return_exceptions=True)

    # From the thread of the camera

    def _see(self, seen: FrameSeen) -> None:
        with contextlib.suppress(RuntimeError):  # the loop may be closed already
            self._loop.call_soon_threadsafe(self._put, seen)

    def _end(self) -> None:
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._finish)

    # In the loop

    def _put(self, seen: FrameSeen) -> None:
        if self._latest is not None:
            self.dropped += 1
        self._latest = seen
        self._news.set()

    def _finish(self) -> None:
        log.info("the source has ended")
        self._ended.set()
        self._news.set()

    async def _send(self, connection: ClientConnection) -> None:
        """The newest frame, whenever the last one has left; ends with the source."""
        while True:
            await self._news.wait()
            self._news.clear()
            seen, self._latest = self._latest, None
            if seen is not None:
                await connection.send(encode(msgspec.structs.replace(seen, sent=self._clock())), text=True)
            if self._ended.is_set():
                await connection.send(encode(self._status("the source has ended")), text=True)
                return

    async def _report(self, connection: ClientConnection) -> None:
        """How the camera is, now and then; and on the log that nothing can be seen."""
        assert self._watch is not None
        said = ""
        while True:
            await connection.send(encode(self._status(self._watch.trouble)), text=True)
            text = black(self._watch.meter.delivery(time.monotonic()))
            if text and not said:
                log.warning("%s", text)
            said = text
            await asyncio.sleep(STATUS_EVERY)

    def _status(self, trouble: str) -> NodeStatus:
        assert self._watch is not None
        delivery = self._watch.meter.delivery(time.monotonic())
        exposure, white, saturated = map(_known, (delivery.exposure, delivery.white, delivery.saturated))
        return NodeStatus(trouble, delivery.rate_hz, delivery.used_hz, exposure, white, saturated, self.dropped)

    async def _hear(self, connection: ClientConnection) -> None:
        """Answer the service's questions, until it ends the connection."""
        said = ""
        async for data in connection:
            received = self._clock()
            try:
                message = to_node(data)
            except MessageError as error:
                log.debug("a message of a newer service? %s", error)
                continue
            match message:
                case ClockQuestion(id=id):
                    await connection.send(encode(ClockAnswer(id, received, self._clock())), text=True)
                case MarkerSizes(shortest_px, longest_px) if self._watch is not None:
                    self._watch.sizes_px(shortest_px, math.inf if longest_px is None else longest_px)
                case Notice(text=text):
                    log.info("the service says: %s", text)
                case Error(reason=reason) if reason != said:
                    said = reason
                    log.warning("the service says: %s", reason)


def _known(value: float) -> float | None:
    """For JSON, which has no nan."""
    return value if math.isfinite(value) else None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help='a camera number, "/dev/video0", "rtsp://...", "picamera", a video file or a folder of images',
    )
    parser.add_argument("--server", required=True, metavar="URL", help="of the service, such as ws://192.168.1.10:5678")
    parser.add_argument("--name", required=True, help='of the camera: that [[camera]] has source = "remote" there')
    parser.add_argument(
        "--token",
        default=os.environ.get("STEADFIX_TOKEN", ""),
        help="of the camera, where the service asks for one; others on this machine see it, but not in STEADFIX_TOKEN",
    )
    parser.add_argument("--certificate", metavar="PATH", help="of the service, for wss://, where it has signed its own")


def run(args: argparse.Namespace) -> int:
    """Runs the command. Raises NodeError, and OSError for nothing: what is lost is tried again."""
    log_to_stderr()
    asyncio.run(_run(args))
    return 0


async def _run(args: argparse.Namespace) -> None:
    node = Node(args.server, args.name, partial(open_source, args.source), args.token, args.certificate)
    await until_stopped(node.run())
