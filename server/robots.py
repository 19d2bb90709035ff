"""One robot of the running service: its filter, its clock, its connection and its figures."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from fusion.diagnosis import Diagnosis
from fusion.health import Health
from fusion.localiser import Localiser
from fusion.measurements import Array, ImuBatch, Pose, PoseFix, WheelOdometry
from imu.clock import DeviceClock, Reading
from imu.health import TURNS_AT_REST, StreamHealth
from imu.mounting import BodyReadings
from imu.protocols import Parser
from server.config import RobotConfig
from server.messages import Dialect, PoseMessage, WheelReading, pose_message

# Seconds over which the rate of the IMU is counted.
RATE_WINDOW = 2.0
# Seconds for which a diagnosis must not have been made until it is gone: one at its threshold comes and goes.
GONE_AFTER = 30.0
_STAMPS = {None: "none yet", True: "by the IMU's own clock", False: "at arrival, since it sends none"}


class Recording(Protocol):
    """What a robot writes to while it runs: every input, in the order in which the filter gets it, and what came of it.

    `server.recording.Recorder` is one.
    """

    def imu(self, batch: ImuBatch) -> None: ...
    def fix(self, fix: PoseFix) -> None: ...
    def wheels(self, odometry: WheelOdometry) -> None: ...
    def track(self, robot: str, track: Array) -> None: ...


class Robot:
    """All times are host monotonic seconds. Everything is called from the service's one loop."""

    def __init__(self, config: RobotConfig, recording: Recording | None = None) -> None:
        self.config = config
        self.localiser = Localiser(config.name, config.filter, config.motion, config.engine)
        self.vitals = Health(self.localiser)
        self.diagnoses: list[Diagnosis] = []
        self.stream = StreamHealth(upright=config.motion != "free")
        self.clock = DeviceClock()
        self._to_body = BodyReadings(config.imu)
        # Why no IMU data come, in words, or "" while they do.
        self.trouble = "no IMU has connected yet"
        self.dropped = 0
        # Host time of the last IMU data.
        self.heard = -math.inf
        self.published = 0
        self._recording = recording
        self._arrivals: deque[tuple[float, int]] = deque()
        self._told: set[tuple[str, str]] = set()

    def connected(self, parser: Parser | None = None, port: str = "") -> None:
        """Its IMU is there, perhaps with a clock that has begun anew; with what reads its bytes, on a serial port."""
        self.clock = DeviceClock()
        self.stream = StreamHealth(upright=self.config.motion != "free", parser=parser, port=port)
        self.vitals.another_imu()
        self._arrivals.clear()
        self.trouble = "it has connected, but sent no IMU data yet"

    def feed_imu(self, raw: Sequence[Reading], arrival: float, now: float) -> None:
        """Readings that reached the service together at `arrival`, and the filter now.

        The order in which inputs reach the filter is what a recording keeps as the order of their arrivals.
        """
        if not raw:
            return
        self.trouble = ""
        self.heard = arrival
        self._arrivals.append((arrival, len(raw)))
        while self._arrivals[0][0] < arrival - RATE_WINDOW:
            self._arrivals.popleft()
        readings = self.clock.stamp(raw, arrival)
        if self._recording is not None:
            # As the IMU gave them: how they become the body's is in the recording too.
            self._recording.imu(ImuBatch(self.config.name, now, readings))
        batch = ImuBatch(self.config.name, now, self._to_body(readings))
        self.stream.feed(raw, batch.samples, arrival)
        track = np.empty((len(raw), 8))
        self.vitals.judged(self.localiser.feed(batch, track))
        self.vitals.sampled(batch.samples, track)
        if self._recording is not None:
            self._recording.track(self.config.name, track)

    def feed_wheels(self, readings: Sequence[WheelReading], arrival: float) -> None:
        """Readings of the wheels that reached the service together, stamped by the clock that stamps the IMU.

        Those without a stamp, or that come before the IMU's first, count as taken at `arrival`.
        """
        rows = np.array(readings, dtype=np.float64)
        for row in rows:
            t = self.clock.to_host(float(row[0]))
            row[0] = min(t, arrival) if math.isfinite(t) else arrival
        odometry = WheelOdometry(self.config.name, arrival, rows)
        if self._recording is not None:
            self._recording.wheels(odometry)
        self.vitals.judged(self.localiser.feed(odometry))
        self.vitals.wheels(odometry)

    def feed_fix(self, fix: PoseFix, now: float) -> None:
        """A fix, which counts as arrived now."""
        fix = replace(fix, arrival=now)
        if self._recording is not None:
            self._recording.fix(fix)
        self.vitals.arrived(fix)
        self.vitals.judged(self.localiser.feed(fix))

    def publish(self, now: float) -> Pose | None:
        """The pose for this instant, as robots steer by it; None before the first fix."""
        pose = self.localiser.pose_at(now, "smooth")
        if pose is not None:
            self.published += 1
            self.vitals.published(pose)
        return pose

    def message(self, pose: Pose, now: float) -> PoseMessage:
        """For everyone."""
        return pose_message(pose, now, self.published)

    def encode_own(self, pose: Pose, now: float, dialect: Dialect) -> bytes:
        """For the robot itself: as it speaks, and with the time by its own clock, where that is known."""
        t_robot = self.clock.to_device(pose.t)
        return dialect.encode(
            pose_message(pose, now, self.published, dialect.ticks(t_robot) if math.isfinite(t_robot) else None)
        )

    def imu_rate_hz(self, now: float) -> float:
        recent = [(t, n) for t, n in self._arrivals if t >= now - RATE_WINDOW]
        if len(recent) < 2:
            return 0.0
        # The first arrival only opens the window: its samples were taken before it.
        return sum(n for _, n in recent[1:]) / max(recent[-1][0] - recent[0][0], 1e-3)

    def diagnose(self, now: float) -> list[str]:
        """Bring `diagnoses` up to date. -> what is new, for the log: each once when it comes and when it goes."""
        self.diagnoses = self.vitals.diagnoses(now)
        said = {diagnosis.code for diagnosis in self.diagnoses} | {TURNS_AT_REST}
        # What needs no fixes to be seen, of an IMU that is not long gone.
        findings = self.stream.findings() if now - self.heard < GONE_AFTER else []
        for diagnosis in (Diagnosis(*finding) for finding in findings if finding.code not in said):
            since, *_ = self.vitals.said.get(diagnosis.key, (now,))
            self.vitals.said[diagnosis.key] = since, now, diagnosis
            self.diagnoses.append(diagnosis)
        news = [diagnosis.text for diagnosis in self.diagnoses if diagnosis.key not in self._told]
        self._told.update(diagnosis.key for diagnosis in self.diagnoses)
        for key in sorted(self._told):
            _, until, diagnosis = self.vitals.said[key]
            if now - until > GONE_AFTER:
                self._told.remove(key)
                news.append(f"no longer: {diagnosis.text}")
        return news

    def health(self, now: float, ready: bool = True) -> dict[str, Any]:
        """What there is to say of it. `ready`: whether the filter may be asked."""
        pose = self.localiser.pose_at(now) if ready else None
        delay = self.clock.minimum_delay
        trouble = self.trouble
        if not trouble and now - self.heard > 1.0:
            trouble = f"no IMU data for {now - self.heard:.0f} s"
        return {
            "mode": "INIT" if pose is None else pose.mode.value,
            "fix_age": None if pose is None or not math.isfinite(pose.fix_age) else round(pose.fix_age, 3),
            "imu_rate_hz": round(self.imu_rate_hz(now), 1),
            "imu": trouble or "ok",
            "imu_protocol": None if self.stream.parser is None else self.stream.parser.protocol or None,
            "imu_refused": self.dropped,
            "clock_skew_ppm": round(self.clock.skew * 1e6, 1),
            "clock_restarts": self.clock.restarts,
            "stamps": _STAMPS[self.clock.has_stamps],
            "link_delay_ms": None if delay is None else round(delay * 1e3, 2),
            "poses_published": self.published,
            "reset_id": 0 if pose is None else pose.reset_id,
            "counts": dict(self.localiser.counts),
            "diagnoses": [
                {"code": d.code, "severity": d.severity, "text": d.text, "evidence": d.evidence} for d in self.diagnoses
            ],
            **self.vitals.figures(now),
        }
