"""The service: one asyncio loop, one port, cameras and serial lines on threads of their own.

Its WebSockets: `/` (the original tracker's stream), `/v1/poses`, `/v1/robot`, `/v1/camera`. Before them stands
`server.door`, with the pages and `/healthz`; what each connection may is in `server.visitor`.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import logging
import math
import secrets
import socket
import threading
import time
from collections.abc import Callable, Collection, Coroutine
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib.metadata import version
from types import TracebackType
from typing import Any, Self, get_args
from urllib.parse import parse_qsl, urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.protocol import State

from fusion.measurements import Pose
from fusion.params import Channel
from imu.protocols.detection import Detector, open_parser
from imu.uart import SerialImu
from server.access import bearer, is_loopback, tls
from server.camera_messages import camera_hello
from server.cameras import FIRST_PAUSE, LONGEST_PAUSE, Camera, Open, Seen, open_configured
from server.clock_questions import ClockQuestions
from server.compiling import NOTICE, PATIENCE, load_or_compile
from server.config import CameraConfig, Config
from server.door import Door
from server.hub import STALL_LIMIT, Hub, Subscription, Topic
from server.listening import cannot_listen
from server.messages import (
    FORMATS,
    ClockAnswer,
    Dialect,
    Error,
    Hello,
    Imu,
    MessageError,
    Notice,
    Welcome,
    Wheels,
    decode_hello,
    decode_watch,
    frame,
)
from server.remote_cameras import RemoteCamera
from server.robots import Recording, Robot
from server.visitor import Connection, RefusedError, Visitor, for_log

log = logging.getLogger("steadfix")

SERVICE = f"steadfix {version('steadfix')}"
# A batch of 200 samples in full precision is 30 KiB.
MAX_MESSAGE = 64 * 1024
# The original stream; a robot's poses are ("own", its name), as it speaks, or (channel, its name, format), for viewers.
TRACKER: Topic = ("tracker",)
# Bytes of the original stream that may wait for a client: there each message counts, so some may.
TRACKER_ROOM = 64 * 1024
# How those are spoken to who have said nothing of it.
PLAIN = Dialect()
# s without a word after which a robot's connection is taken for dead, and another may take its place.
SILENCE = 3.0
# s between two rounds of diagnoses; and their share of the loop's time within one, since each takes some milliseconds.
DIAGNOSE_EVERY, DIAGNOSE_SHARE = 5.0, 0.03
# s that a camera waits for the filters' word; without it, it looks where the markers were last.
POSES_TIMEOUT = 0.05
# s that closing may take: for clients that do not answer, and for threads that hang in a driver.
CLOSE_TIMEOUT = 0.7

_MODES = {
    "INIT": "no fix yet",
    "COAST": "no fix for a while, the IMU alone",
    "DEGRADED": "too long without a fix to steer by",
    "INVALID": "too long without a fix to be good for anything",
    "NO_IMU": "no IMU data, fixes alone",
    "LOST": "neither fixes nor IMU data",
}


@dataclass(eq=False)
class _Link:
    """A robot's connection."""

    visitor: Visitor
    heard: float
    questions: ClockQuestions = field(default_factory=ClockQuestions)


class Service:
    """`async with Service(config) as service:` runs it; then `service.port` is the port that it listens on.

    `recording` gets all inputs, `published` each pose. `failed` is a future that a fault in the background ends.
    Raises OSError in words when the port cannot be had, and what `Camera` raises.
    """

    def __init__(
        self,
        config: Config,
        recording: Recording | None = None,
        open_camera: Open = open_configured,
        published: Callable[[Pose], None] | None = None,
    ) -> None:
        self.config = config
        self.hub = Hub(tick=1.0 / config.server.pose_rate_hz)
        self.robots = {robot.name: Robot(robot, recording) for robot in config.robot}
        self.cameras = {camera.name: self._camera(camera, open_camera) for camera in config.camera}
        self.port = 0
        # Set once the filters' kernels are compiled; what comes before is not fed.
        self.ready = asyncio.Event()
        self._visitors: set[Visitor] = set()
        self._refused = 0  # of visitors that have gone, and besides single messages
        self._links: dict[str, _Link] = {}
        self._started = time.monotonic()
        self._published = published
        self._door = Door(config.server, self.health, lambda: len(self._visitors))
        self._loop = asyncio.get_running_loop()
        self._server: Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.failed: asyncio.Future[None] = self._loop.create_future()

    async def __aenter__(self) -> Self:
        host, port = self.config.server.host, self.config.server.port
        try:
            self._server = await serve(
                self._serve,
                host,
                port,
                process_request=self._door.answer,
                ssl=tls(self.config.server.certificate, self.config.server.key),
                create_connection=Connection,
                compression=None,
                max_size=MAX_MESSAGE,
                close_timeout=CLOSE_TIMEOUT,
                server_header=None,
            )
        except OSError as error:
            raise cannot_listen(error, host, port) from None
        self.port = self._server.sockets[0].getsockname()[1]
        if not is_loopback(host):
            self._say_who_is_let_in(host)
        for camera in self.cameras.values():
            camera.start()
        self._spawn(self._warm_up())
        self._spawn(self._publish())
        self._spawn(self._diagnose())
        for robot in self.robots.values():
            if robot.config.imu.source != "websocket":
                self._spawn(self._read_serial(robot))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for camera in self.cameras.values():
            camera.stop()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._server is not None:
            self._server.close(code=CloseCode.GOING_AWAY, reason="the service is ending")
            await self._server.wait_closed()
        await asyncio.gather(*(asyncio.to_thread(camera.join, CLOSE_TIMEOUT) for camera in self.cameras.values()))

    def _camera(self, config: CameraConfig, open_camera: Open) -> Camera:
        def wanted() -> bool:
            return self.hub.wants(TRACKER)

        if config.source == "remote":
            return RemoteCamera(config, self.config, self._deliver, wanted)
        return Camera(config, self.config, self._deliver, wanted, open_camera, self._poses_at)

    def _say_who_is_let_in(self, host: str) -> None:
        server = self.config.server
        tokenless = [robot.name for robot in self.config.robot if not robot.token and robot.imu.source == "websocket"]
        if not server.token:
            log.warning("listening on %s, but [server] has no token: poses and health for this machine only", host)
        if tokenless:
            log.warning("without a token, taken from this machine only: %s", ", ".join(tokenless))
        if not server.certificate and (server.token or len(tokenless) < len(self.config.robot)):
            log.warning("without a certificate under [server], tokens can be read by others on the network")

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run in the background; if it fails, which nothing here should, the service fails instead of limping on."""
        task = asyncio.create_task(work)
        self._tasks.add(task)

        def done(task: asyncio.Task[None]) -> None:
            self._tasks.discard(task)
            if not task.cancelled() and (error := task.exception()) is not None and not self.failed.done():
                self.failed.set_exception(error)

        task.add_done_callback(done)

    async def _warm_up(self) -> None:
        warm: asyncio.Future[None] = self._loop.create_future()

        def end(error: Exception | None) -> None:
            if error is not None:
                warm.set_exception(error)
            else:
                warm.set_result(None)

        camera = not all(isinstance(camera, RemoteCamera) for camera in self.cameras.values())

        def work() -> None:
            try:
                for engine in sorted({robot.config.engine for robot in self.robots.values()}):
                    load_or_compile(engine, camera=camera)
            except Exception as error:
                self._call_from_thread(end, error)
            else:
                self._call_from_thread(end, None)

        # A daemon, unlike the threads of asyncio: compiling must not keep the service from ending.
        threading.Thread(target=work, name="warm-up", daemon=True).start()
        notice = self._loop.call_later(PATIENCE, log.info, NOTICE)
        try:
            await asyncio.shield(warm)
        finally:
            notice.cancel()
        self.ready.set()

    # Inputs

    def _deliver(self, seen: Seen) -> None:
        """From a camera's thread."""
        self._call_from_thread(self._seen, seen)

    def _poses_at(self, t: float) -> dict[str, Pose]:
        """From a camera's thread: where the robots were at `t`, as far as their filters, which are the loop's, know."""
        answer: concurrent.futures.Future[dict[str, Pose]] = concurrent.futures.Future()

        def look() -> None:
            robots = self.robots if self.ready.is_set() else {}
            # What the filters find the camera's stamps to be off by is theirs alone.
            poses = {name: r.localiser.pose_at(t + r.localiser.time_offset) for name, r in robots.items()}
            answer.set_result({name: pose for name, pose in poses.items() if pose is not None})

        self._call_from_thread(look)
        try:
            return answer.result(POSES_TIMEOUT)
        except TimeoutError:
            return {}

    def _call_from_thread(self, function: Callable[..., None], *arguments: object) -> None:
        # The loop may be closed while a thread still ends: nobody needs what it brings then.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)

    def _seen(self, seen: Seen) -> None:
        now = time.monotonic()
        for message in seen.tracker:
            self.hub.publish(now, {TRACKER: message}.get)
        if self.ready.is_set():
            for fix in seen.fixes:
                self.robots[fix.robot].feed_fix(fix, now)

    async def _read_serial(self, robot: Robot) -> None:
        """Read a robot's serial port, and open it again whenever it is lost."""
        pause = FIRST_PAUSE
        while True:
            heard = robot.heard
            try:
                await self._read_port(robot)
            except (OSError, ValueError) as error:
                if robot.trouble != str(error):
                    log.warning("robot %s: %s; trying again until it works", robot.config.name, error)
                robot.trouble = str(error)
            pause = FIRST_PAUSE if robot.heard > heard else pause
            await asyncio.sleep(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE)

    async def _read_port(self, robot: Robot) -> None:
        """The same until the port is lost (OSError) or cannot be opened (OSError, ValueError for the baud rate)."""
        name, imu = robot.config.name, robot.config.imu
        parser = open_parser(imu.protocol, imu.columns, imu.baud)
        port: SerialImu | None = None
        lost: asyncio.Future[None] = self._loop.create_future()

        def read(data: bytes, arrival: float) -> None:
            dropped, protocol = parser.dropped, parser.protocol
            samples = parser.feed(data)
            if parser.protocol != protocol:
                log.info("robot %s: %s speaks %s", name, imu.source, parser.protocol)
            if isinstance(parser, Detector) and port is not None and parser.baud != port.baud:
                port.set_baud(parser.baud)
            if parser.dropped > dropped:
                if dropped == 0:
                    log.warning("robot %s: %s: %s", name, imu.source, parser.last_error)
                robot.dropped += parser.dropped - dropped
                robot.trouble = f"it sends what cannot be used: {parser.last_error}"
            if self.ready.is_set():
                robot.feed_imu(samples, arrival, time.monotonic())

        def end(error: OSError) -> None:
            if not lost.done():
                lost.set_exception(error)

        from_thread = self._call_from_thread
        port = await asyncio.to_thread(
            SerialImu, imu.source, imu.baud, functools.partial(from_thread, read), functools.partial(from_thread, end)
        )
        try:
            robot.connected(parser, imu.source)
            log.info("robot %s: %s is open", name, imu.source)
            topics = [("own", name)] if imu.pose_rate_hz > 0.0 else []
            with self.hub.subscribed(
                lambda data: port.write(data + b"\n"), lambda: 0, port.close, topics, imu.pose_rate_hz
            ):
                await lost
        finally:
            await asyncio.to_thread(port.close)

    # Outputs

    async def _publish(self) -> None:
        await self.ready.wait()
        due = time.monotonic()
        while True:
            self._publish_poses(time.monotonic())
            # On schedule; after a pause from now, not in a burst.
            now = time.monotonic()
            due = max(due + self.hub.tick, now)
            await asyncio.sleep(due - now)

    def _publish_poses(self, now: float) -> None:
        # What robots steer by: given out once, to whomever.
        given: dict[str, Pose | None] = {}
        if self._published is not None:
            given = {name: self._pose(robot, now) for name, robot in self.robots.items()}

        def message(topic: Topic) -> bytes | None:
            if topic == TRACKER:
                return None
            channel, name, *format = topic
            robot = self.robots[name]
            if name not in given:
                given[name] = self._pose(robot, now)
            pose = robot.localiser.pose_at(now) if channel == "best" else given[name]
            if pose is None:
                return None
            if channel == "own":
                link = self._links.get(name)
                return robot.encode_own(pose, now, link.visitor.dialect if link is not None else PLAIN)
            return FORMATS[format[0]](robot.message(pose, now))

        self.hub.publish(now, message)
        for _ in self.hub.sweep(now):
            log.warning("a client took nothing for %.0f s and was cut off", STALL_LIMIT)

    def _pose(self, robot: Robot, now: float) -> Pose | None:
        pose = robot.publish(now)
        if pose is not None and self._published is not None:
            self._published(pose)
        return pose

    async def _diagnose(self) -> None:
        await self.ready.wait()
        while True:
            await asyncio.sleep(DIAGNOSE_EVERY)
            for name, robot in self.robots.items():
                begin = time.monotonic()
                for text in robot.diagnose(begin):
                    self._note(name, text)
                await asyncio.sleep((time.monotonic() - begin) / DIAGNOSE_SHARE)
            for name, camera in self.cameras.items():
                for text in camera.news(time.monotonic()):
                    log.info("camera %s: %s", name, text)

    def _note(self, name: str, text: str) -> None:
        """Say what looks wrong with a robot's data: in the log, and to the robot."""
        log.info("robot %s: %s", name, text)
        if (link := self._links.get(name)) is not None:
            link.visitor.tell_now(Notice(text))

    @property
    def refused(self) -> int:
        """Messages and connections that could not be used."""
        return self._refused + sum(visitor.refused for visitor in self._visitors)

    def health(self) -> dict[str, Any]:
        now = time.monotonic()
        # Asked before it is compiled, a filter would compile here and now.
        robots = {name: robot.health(now, self.ready.is_set()) for name, robot in self.robots.items()}
        cameras = {name: camera.health(now) for name, camera in self.cameras.items()}
        reasons = [] if self.ready.is_set() else ["the filters are being compiled, which may take a minute"]
        for name, camera in cameras.items():
            if camera["status"] != "ok":
                reasons.append(f"camera {name}: {camera['status']}")
            elif not camera["located"]:
                reasons.append(f"camera {name}: {camera['location']}")
        for name, robot in robots.items():
            if not self.ready.is_set():
                break
            if robot["imu"] != "ok":
                reasons.append(f"robot {name}: {robot['imu']}")
            elif robot["mode"] != "FULL":
                reasons.append(f"robot {name}: {_MODES[robot['mode']]}")
            # What a fix's absence has to say, the mode has said.
            told = [d["text"] for d in robot["diagnoses"] if d["severity"] != "note" and d["code"] != "no_fix"]
            reasons += [f"robot {name}: {text}" for text in told]
        return {
            "status": "degraded" if reasons else "ok",
            "reasons": reasons,
            "service": SERVICE,
            "uptime": round(now - self._started, 1),
            "clients": len(self.hub.subscriptions),
            "messages_refused": self.refused,
            "messages_dropped": self.hub.dropped,
            "clients_cut_off": self.hub.cut_off,
            "robots": robots,
            "cameras": cameras,
            "anchors": [
                {"id": anchor.id, "position_m": anchor.position_m, "yaw_deg": anchor.yaw_deg, "size_mm": anchor.size_mm}
                for anchor in self.config.anchor
            ],
        }

    # WebSockets

    async def _serve(self, connection: ServerConnection) -> None:
        assert isinstance(connection, Connection)
        assert connection.request is not None
        url = urlsplit(connection.request.path)
        visitor = Visitor(connection, url.path)
        self._visitors.add(visitor)
        try:
            if url.path == "/v1/robot":
                await self._serve_robot(visitor)
            elif url.path == "/v1/camera":
                await self._serve_camera(visitor)
            elif url.path == "/v1/poses":
                await self._serve_poses(visitor, url.query)
            else:
                await self._serve_tracker(visitor)
        except RefusedError as error:
            self._refused += 1
            log.warning("%s was refused: %s", visitor.name, for_log(str(error)))
            with contextlib.suppress(ConnectionClosed):
                await visitor.tell(Error(str(error), error.retry))
                # A close frame holds 123 bytes of reason.
                code = CloseCode.TRY_AGAIN_LATER if error.retry else CloseCode.POLICY_VIOLATION
                await connection.close(code, str(error).encode()[:120].decode(errors="ignore"))
        except ConnectionClosed as error:
            if error.sent is not None and error.sent.code == CloseCode.MESSAGE_TOO_BIG:
                self._refused += 1
                log.warning("%s sent a message of more than %d bytes and was closed", visitor.name, MAX_MESSAGE)
        finally:
            self._visitors.remove(visitor)
            self._refused += visitor.refused
            if visitor.refused > 1:
                log.warning("%s: %d messages were refused in all", visitor.name, visitor.refused)

    async def _serve_tracker(self, visitor: Visitor) -> None:
        with self._client(visitor, [TRACKER], room=TRACKER_ROOM):
            while True:
                await visitor.receive()  # the original ignored what its clients sent

    async def _serve_poses(self, visitor: Visitor, query: str) -> None:
        token = bearer(visitor.headers)
        if not visitor.local:
            if not token and self.config.server.token:
                token = (await visitor.hello(decode_watch)).token
            await visitor.admit(token, self.config.server.token, "[server]")
        robots, rate_hz, channel, format = self._poses_query(query)
        visitor.dialect = Dialect(binary=format == "msgpack")
        with self._client(visitor, [(channel, robot, format) for robot in robots], rate_hz):
            while True:
                data = await visitor.receive()
                with contextlib.suppress(MessageError):
                    decode_watch(data)  # a page says its token wherever it is
                    continue
                await visitor.refuse(MessageError("/v1/poses only sends; robots speak on /v1/robot"))

    def _poses_query(self, query: str) -> tuple[list[str], float, str, str]:
        robots, rate_hz, channel, format = list(self.robots), self.config.server.pose_rate_hz, "smooth", "json"
        for key, value in parse_qsl(query, keep_blank_values=True):
            if key == "robots":
                robots = [name for name in value.split(",") if name]
                for name in robots:
                    self._known(name)
            elif key == "rate":
                try:
                    rate_hz = float(value)
                except ValueError:
                    rate_hz = math.nan
                if not 0.0 < rate_hz <= 1000.0:
                    raise RefusedError(f"rate={value}: poses a second are needed, above 0 and up to 1000")
            elif key == "channel":
                channel = value
                if channel not in get_args(Channel):
                    raise RefusedError(f"channel={value}: there are {' and '.join(get_args(Channel))}")
            elif key == "format":
                format = value
                if format not in FORMATS:
                    raise RefusedError(f"format={value}: there are {' and '.join(FORMATS)}")
            else:
                known = "robots=a,b, rate=50, channel=best and format=msgpack"
                raise RefusedError(f"{key}={value} is not known here; {known} are")
        return robots, rate_hz, channel, format

    def _known(self, name: str) -> Robot:
        if name not in self.robots:
            known = ", ".join(self.robots) or "none"
            raise RefusedError(f'there is no robot "{name}" in the configuration; known: {known}')
        return self.robots[name]

    def _client(
        self, visitor: Visitor, topics: Collection[Topic], rate_hz: float = 0.0, room: int = 0
    ) -> AbstractContextManager[Subscription]:
        protocol, transport = visitor.connection.protocol, visitor.connection.transport
        text = not visitor.dialect.binary
        if (sock := transport.get_extra_info("socket")) is not None and hasattr(socket, "TCP_NOTSENT_LOWAT"):
            # What a slow client has not taken then waits here, where the newer replaces it, and not in the kernel.
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, 16 * 1024)

        def write(data: bytes) -> None:
            # As `websockets.broadcast`, in fewer steps: thousands of poses a second leave here.
            if protocol.state is State.OPEN:
                transport.write(frame(data, text))

        return self.hub.subscribed(
            write,
            transport.get_write_buffer_size,
            transport.abort,
            topics,
            rate_hz,
            room,
        )

    async def _serve_camera(self, visitor: Visitor) -> None:
        hello = await visitor.hello(camera_hello)
        token = hello.token or bearer(visitor.headers)
        camera = self.cameras.get(hello.camera)
        if camera is None and not visitor.local:
            await visitor.admit(token, secrets.token_hex(), f'camera "{hello.camera}"')
        if not isinstance(camera, RemoteCamera):
            known = ", ".join(name for name, camera in self.cameras.items() if isinstance(camera, RemoteCamera))
            raise RefusedError(
                f'there is no remote camera "{hello.camera}" in the configuration (source = "remote"); '
                f"known: {known or 'none'}"
            )
        await visitor.admit(token, camera.config.token, f'camera "{hello.camera}"')
        if taken := camera.refusal(time.monotonic()):
            raise RefusedError(taken, retry=True)
        await camera.serve(visitor.connection, visitor.address, SERVICE, visitor.receive, visitor.refuse)

    async def _serve_robot(self, visitor: Visitor) -> None:
        hello = await visitor.hello(decode_hello)
        visitor.dialect = Dialect(hello, visitor.dialect.binary)
        token = hello.token or bearer(visitor.headers)
        if hello.robot in self.robots or visitor.local:
            configured = self._known(hello.robot).config.token
        else:
            configured = secrets.token_hex()  # which names there are is not told to everybody
        await visitor.admit(token, configured, f'robot "{hello.robot}"')
        robot = self._known(hello.robot)
        if robot.config.imu.source != "websocket":
            raise RefusedError(f'the IMU of "{hello.robot}" is on {robot.config.imu.source}, by the configuration')
        link = self._take(robot, visitor)
        rate_hz = min(hello.pose_rate_hz, self.config.server.pose_rate_hz)
        visitor.tell_now(Welcome(hello.robot, SERVICE, rate_hz))
        log.info("robot %s has connected", hello.robot)
        topics = [("own", hello.robot)] if rate_hz > 0.0 else []
        clock = asyncio.create_task(self._ask_clock(link))
        try:
            with self._client(visitor, topics, rate_hz) as subscription:

                def take(data: str | bytes) -> None:
                    link.heard = time.monotonic()
                    self._hear(robot, link, data, link.heard)
                    self._answer_robot(robot, link, subscription)

                while True:
                    data = await visitor.receive(take)
                    try:
                        take(data)
                    except MessageError as error:
                        robot.dropped += 1
                        await visitor.refuse(error)
        finally:
            clock.cancel()
            if self._links.get(hello.robot) is link:
                del self._links[hello.robot]
                robot.trouble = "its connection has ended"
                if self._server is not None and self._server.is_serving():
                    log.info("robot %s has gone", hello.robot)

    def _take(self, robot: Robot, visitor: Visitor) -> _Link:
        """Make this the robot's connection. One that has been silent, as after a lost link, gives way."""
        name, now = robot.config.name, time.monotonic()
        before = self._links.get(name)
        if before is not None:
            if now - before.heard < SILENCE:
                raise RefusedError(f'robot "{name}" is already connected, from {before.visitor.address}', retry=True)
            log.info("robot %s has connected anew; its old connection was silent", name)
            before.visitor.connection.transport.abort()
        link = self._links[name] = _Link(visitor, now)
        robot.connected()
        return link

    def _hear(self, robot: Robot, link: _Link, data: str | bytes, arrival: float) -> None:
        dialect = link.visitor.dialect
        match dialect.decode(data):
            case Imu() as message:
                readings = dialect.readings(message)
                if not self.ready.is_set():
                    return
                restarts = robot.clock.restarts
                robot.feed_imu(readings, arrival, arrival)
                if robot.clock.restarts > restarts:
                    self._note(robot.config.name, f"its clock has jumped or started anew; it reads {readings[-1][0]} s")
            case Wheels() as message:
                wheels = dialect.wheels(message)
                if self.ready.is_set():
                    robot.feed_wheels(wheels, arrival)
            case ClockAnswer(id, received, sent):
                link.questions.take(id, dialect.seconds(received), dialect.seconds(sent), arrival, robot.clock)
            case Hello():
                raise MessageError("a second hello")

    def _answer_robot(self, robot: Robot, link: _Link, subscription: Subscription) -> None:
        """Its pose at once, with what it just sent in it, as far as the rate that it asked for allows."""
        now = time.monotonic()
        if subscription.topics and self.ready.is_set() and self.hub.is_due(now, subscription, answer=True):
            pose = self._pose(robot, now)
            if pose is not None:
                self.hub.send(now, subscription, robot.encode_own(pose, now, link.visitor.dialect))

    async def _ask_clock(self, link: _Link) -> None:
        visitor, questions = link.visitor, link.questions
        while True:
            # A question that waits behind unsent poses would measure those.
            if visitor.connection.transport.get_write_buffer_size() == 0:
                visitor.tell_now(questions.ask(time.monotonic()))
            await asyncio.sleep(questions.pause)
