"""Cameras on other machines: their nodes (`server.camera_node`) capture and find markers, the service does the rest.

The calibration stays with the service, as do the anchors and robots that it belongs with: a node has nothing but its
name and the address of the service, and all else that it needs to know comes with the welcome.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
from websockets.asyncio.server import ServerConnection, broadcast

from camera.calibration import CalibrationError
from camera.exposure import Delivery
from camera.markers import MarkerSighting
from camera.settings import CaptureSettings
from imu.clock import DeviceClock
from server.camera_messages import (
    CameraHello,
    CameraWelcome,
    FrameSeen,
    MarkerSizes,
    NodeStatus,
    encode,
    from_node,
)
from server.cameras import Camera, Seen, SightedFrame
from server.clock_questions import ClockQuestions
from server.config import CameraConfig, Config
from server.messages import ClockAnswer, MessageError, Notice

log = logging.getLogger("steadfix.camera")

# s without a word after which a node counts as gone, and another connection of it may take its place.
SILENCE = 3.0


class RemoteFrames:
    """The frames of a node as a source: the newest waits to be read, as with a camera that is here."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._frame: SightedFrame | None = None
        self._closed = False

    def put(self, frame: SightedFrame) -> None:
        """A frame came; one that was not read yet is forgotten."""
        with self._changed:
            self._frame = frame
            self._changed.notify_all()

    def read(self, timeout: float) -> SightedFrame | None:
        """The next frame, None once closed. Waits for as long as the node is away, who says so by other means."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._frame is not None)
            frame, self._frame = self._frame, None
            return None if self._closed else frame

    def close(self) -> None:
        """Ends a `read` that waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class RemoteCamera(Camera):
    """A Camera whose frames come over a connection, one at a time, from whichever node bears its name.

    `serve` is for the service's loop, the rest as in Camera.
    """

    def __init__(
        self,
        config: CameraConfig,
        room: Config,
        deliver: Callable[[Seen], None],
        tracker_wanted: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(config, room, deliver, tracker_wanted, self._open_frames)
        self.status = (
            "its node has not connected yet; on the machine with the camera: "
            f"steadfix camera SOURCE --server ws://<this machine>:{room.server.port} --name {config.name}"
        )
        self.clock = DeviceClock()
        self.node = ""
        self.dropped = 0
        self._frames = RemoteFrames()
        self._connection: ServerConnection | None = None
        self._heard = -math.inf
        self._delivery: Delivery | None = None
        self._trouble = ""

    def _open_frames(self, config: CameraConfig) -> RemoteFrames:
        self._frames = RemoteFrames()
        return self._frames

    @property
    def connected(self) -> bool:
        """Whether its node is there; a last frame may still be worked on when it has gone."""
        return self._connection is not None

    def refusal(self, now: float) -> str:
        """Why no second connection can be this camera's, or "": one that is silent, as after a lost link, gives way."""
        if self._connection is None or now - self._heard >= SILENCE:
            return ""
        return f'camera "{self.config.name}" is already connected, from {self.node}'

    async def serve(
        self,
        connection: ServerConnection,
        node: str,
        service: str,
        receive: Callable[[], Awaitable[str | bytes]],
        refuse: Callable[[MessageError], Awaitable[None]],
    ) -> None:
        """One connection, after its hello, until it ends (ConnectionClosed). `node`: where it comes from, in words;
        `receive` gets its next message, `refuse` tells it what was wrong with one."""
        if self._connection is not None:
            self._connection.transport.abort()
        self._connection, self.node, self._heard = connection, node, time.monotonic()
        # The node may be another than before, or started anew.
        self.clock, self._delivery = DeviceClock(), None
        self._trouble = ""
        self._say(f"its node has connected, from {node}, but has sent no frame yet")
        config = self.config
        welcome = CameraWelcome(
            camera=config.name,
            service=service,
            dictionary=config.dictionary,
            ids=sorted(self.ids),
            still=sorted(self.anchor_ids),
            **{name: getattr(config, name) for name in CaptureSettings.__struct_fields__},
        )
        questions = ClockQuestions()
        tending = None
        try:
            await connection.send(encode(welcome), text=True)
            tending = asyncio.create_task(self._tend(connection, questions))
            while True:
                data = await receive()
                arrival = self._heard = time.monotonic()
                try:
                    self._hear(questions, data, arrival)
                except MessageError as error:
                    await refuse(error)
        finally:
            if tending is not None:
                tending.cancel()
            if self._connection is connection:
                self._connection = None
            if self._connection is None and not self._thread.stopping.is_set():
                # A frame may have come after what the node said last.
                self._say(f"its node ({node}) has gone; waiting for it{self._trouble and f' ({self._trouble})'}")

    def _say(self, status: str) -> None:
        if status != self.status:
            self.status = status
            log.info("camera %s: %s", self.config.name, status)

    async def _tend(self, connection: ServerConnection, questions: ClockQuestions) -> None:
        """Ask for the node's clock, tell it what is found out about its camera, and miss it when it is silent."""
        told = None
        while True:
            now = time.monotonic()
            # A question that waits behind others would measure those.
            if connection.transport.get_write_buffer_size() == 0:
                broadcast([connection], encode(questions.ask(now)), text=True)
            if self.frames and (placement := self.placement) is not None and placement is not told:
                told = placement
                shortest, longest = self._sides_px(placement)
                sizes = MarkerSizes(shortest, longest if math.isfinite(longest) else None)
                broadcast([connection], encode(sizes), text=True)
            if now - self._heard >= SILENCE and self._connection is connection:
                self._say(f"its node ({self.node}) says nothing any more; waiting for it")
            await asyncio.sleep(questions.pause)

    def _hear(self, questions: ClockQuestions, data: str | bytes, arrival: float) -> None:
        match from_node(data):
            case FrameSeen() as seen:
                self.clock.observe(seen.sent, arrival)
                # What has no time yet has to wait for the answer to the first question, which is under way.
                if self.clock.minimum_delay is not None:
                    self._frames.put(self._frame(seen))
            case ClockAnswer(id, received, sent):
                questions.take(id, received, sent, arrival, self.clock)
            case NodeStatus() as status:
                known = (math.nan if x is None else x for x in (status.exposure, status.white, status.saturated))
                self._delivery = Delivery(status.rate_hz, status.used_hz, *known)
                self.dropped = status.dropped
                self._trouble = status.trouble
                if status.trouble:
                    self._say(status.trouble)
            case CameraHello():
                raise MessageError("a second hello")

    def _frame(self, seen: FrameSeen) -> SightedFrame:
        ids = sorted(marker.id for marker in seen.markers)
        if not self.ids.issuperset(ids):
            raise MessageError(f"markers that were not asked for: {sorted(set(ids) - self.ids)}")
        if len(set(ids)) < len(ids):
            raise MessageError(f"a marker twice, in {ids}: which one is meant?")
        if not seen.t <= seen.sent:
            raise MessageError(f"a frame of {seen.t - seen.sent:.3g} s after it was sent")
        try:
            self.intrinsics.check_size(seen.width_px, seen.height_px)
        except CalibrationError as error:
            # Said at both ends: either may be where it is put right.
            self._say(str(error))
            raise MessageError(str(error)) from None
        to_host, offset = self.clock.to_host, self.config.time_offset
        sightings = [
            MarkerSighting(
                to_host(marker.t) + offset,
                self.config.name,
                marker.id,
                np.array(marker.corners_px),
                marker.sigma_px,
                math.nan if marker.blur_px is None else marker.blur_px,
            )
            for marker in sorted(seen.markers, key=lambda marker: marker.id)
        ]
        return SightedFrame(
            t=to_host(seen.t) + offset,
            sequence=seen.sequence,
            width_px=seen.width_px,
            height_px=seen.height_px,
            sightings=sightings,
            detect_ms=seen.detect_ms,
            repeated=self.ids.intersection(seen.repeated),
        )

    def delivery(self, now: float) -> Delivery | None:
        """As its node measured it."""
        return self._delivery

    def news(self, now: float) -> list[str]:
        """As in Camera; said to the node as well, where someone may be on the ladder."""
        news = super().news(now)
        if self._connection is not None:
            for text in news:
                broadcast([self._connection], encode(Notice(text)), text=True)
        return news

    def health(self, now: float) -> dict[str, Any]:
        delay = self.clock.minimum_delay
        return super().health(now) | {
            "node": self.node if self.connected else None,
            "clock_skew_ppm": round(self.clock.skew * 1e6, 1),
            "link_delay_ms": None if delay is None else round(delay * 1e3, 2),
            "frames_dropped": self.dropped,
        }
