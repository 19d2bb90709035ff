"""A small robot with two driven wheels and the IMU on it: truth, and what its sensor makes of it."""

from __future__ import annotations

import math
import random

from fusion.params import GRAVITY

Vector = tuple[float, float, float]

# m between the wheels; m/s2 that the motors can do; s of their lag; s without a command until they stop.
TRACK = 0.16
MAX_ACCELERATION = 2.0
MOTOR_LAG = 0.08
COMMAND_TIMEOUT = 0.3
# Slip of each wheel: a share of its speed that wanders by this much, and how quickly, s.
SLIP = 0.02
SLIP_TIME = 0.5
# The walls, m from the middle of the room.
ROOM_X, ROOM_Y = 1.9, 1.4


class Body:
    """Pose on the floor (m, rad), and what the wheels do. The body's origin is on the floor between the wheels."""

    def __init__(self, x: float, y: float, yaw: float, seed: str) -> None:
        self.x, self.y, self.yaw = x, y, yaw
        self.speed = self.turn_rate = self.acceleration = 0.0
        self._random = random.Random(f"body {seed}")
        self._command = (0.0, 0.0)
        self._command_age = math.inf
        self._wheels = [0.0, 0.0]
        self._slip = [0.0, 0.0]

    def command(self, speed: float, turn_rate: float) -> None:
        """m/s and rad/s, to be reached as well as the motors can."""
        half = 0.5 * TRACK * turn_rate
        self._command = (speed - half, speed + half)
        self._command_age = 0.0

    def step(self, h: float) -> None:
        """Move on by `h` s."""
        self._command_age += h
        wanted = self._command if self._command_age < COMMAND_TIMEOUT else (0.0, 0.0)
        decay, kick = math.exp(-h / SLIP_TIME), SLIP * math.sqrt(2.0 * h / SLIP_TIME)
        rolled = []
        for i in range(2):
            change = (wanted[i] - self._wheels[i]) * h / MOTOR_LAG
            limit = MAX_ACCELERATION * h
            self._wheels[i] += min(max(change, -limit), limit)
            self._slip[i] = decay * self._slip[i] + kick * self._random.gauss(0.0, 1.0)
            rolled.append(self._wheels[i] * (1.0 - self._slip[i]))
        speed, self.turn_rate = 0.5 * (rolled[0] + rolled[1]), (rolled[1] - rolled[0]) / TRACK
        middle = self.yaw + 0.5 * h * self.turn_rate
        x, y = self.x + h * speed * math.cos(middle), self.y + h * speed * math.sin(middle)
        if abs(x) > ROOM_X or abs(y) > ROOM_Y:
            x, y, speed = self.x, self.y, 0.0
        self.acceleration = (speed - self.speed) / h
        self.speed = speed
        self.x, self.y, self.yaw = x, y, self.yaw + h * self.turn_rate


class Imu:
    """A MEMS IMU of the cheap kind, on a robot that shakes it: the figures of a datasheet, and vibration on top."""

    def __init__(self, seed: str, rate_hz: float) -> None:
        self._random = random.Random(f"imu {seed}")
        gauss = self._random.gauss
        self._h = 1.0 / rate_hz
        self._phase = 0.0
        # rad/s and m/s2: a bias from switching on, and its walk per square root of a second
        self._gyro_bias = [gauss(0.0, 0.01) for _ in range(3)]
        self._accel_bias = [gauss(0.0, 0.08) for _ in range(3)]
        self._gyro_scale = [1.0 + gauss(0.0, 0.005) for _ in range(3)]
        self._accel_scale = [1.0 + gauss(0.0, 0.005) for _ in range(3)]

    def read(self, body: Body) -> tuple[Vector, Vector]:
        """(angular rate, specific force), rad/s and m/s2, body axes, of the last step."""
        # The wheels' profile: 25 lugs a metre. It shakes most what is up and down.
        self._phase += 2.0 * math.pi * 25.0 * body.speed * self._h
        shake = min(1.0, abs(body.speed) / 0.5)
        wave = (math.sin(self._phase), math.cos(1.3 * self._phase), math.sin(1.7 * self._phase))
        gyro_truth = (0.0, 0.0, body.turn_rate)
        accel_truth = (body.acceleration, body.speed * body.turn_rate, GRAVITY)
        gyro = self._sense(
            gyro_truth, self._gyro_bias, self._gyro_scale, wave, shake, 1.3e-3, 2e-5, 0.02, math.radians(2000) / 32768
        )
        accel = self._sense(
            accel_truth, self._accel_bias, self._accel_scale, wave, shake, 0.02, 3e-4, 0.3, 4 * GRAVITY / 32768
        )
        return gyro, accel

    def _sense(
        self,
        truth: Vector,
        bias: list[float],
        scale: list[float],
        wave: Vector,
        shake: float,
        noise: float,
        walk: float,
        vibration: float,
        step: float,
    ) -> Vector:
        """`noise`: sigma of one sample; `walk`: per sqrt(s); `vibration`: amplitude; `step`: of the digits."""
        gauss = self._random.gauss
        kick = walk * math.sqrt(self._h)
        read = []
        for i in range(3):
            bias[i] += gauss(0.0, kick)
            shaken = shake * vibration * (wave[i] + gauss(0.0, 0.5))
            value = truth[i] * scale[i] + bias[i] + gauss(0.0, noise) + shaken
            read.append(step * round(value / step))
        return read[0], read[1], read[2]
