"""A robot in MicroPython (ESP32, Pico W, ...): sends its IMU, and gets its pose. Copy it to the board as main.py.

The network must be up: https://docs.micropython.org/en/latest/esp32/quickref.html#networking
"""

import binascii
import json
import os
import select
import socket
import time

HOST, PORT = "192.168.1.10", 5678
ROBOT, TOKEN = "rover", ""  # the token that the configuration gives the robot
PERIOD_US = 5000  # between samples
BATCH = 10  # samples sent together
WRAPS_AT = time.ticks_add(0, -1) + 1  # where ticks_us() begins again


def read_imu():
    """Yours: rad/s about x (forward), y (left) and z (up), then m/s2 along them, +9.81 on z at rest."""
    return 0.0, 0.0, 0.0, 0.0, 0.0, 9.81


def steer(pose):
    """Yours: m, rad; there is much more in it, see the README."""
    print(pose["position"], pose["yaw"], pose["mode"])


class Service:
    """A WebSocket (RFC 6455) for short texts, which is all that is needed here."""

    def __init__(self):
        self.socket = socket.socket()
        self.socket.connect(socket.getaddrinfo(HOST, PORT)[0][-1])
        key = binascii.b2a_base64(os.urandom(16)).strip().decode()
        request = (
            f"GET /v1/robot HTTP/1.1\r\nHost: {HOST}:{PORT}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n"
        )
        self.socket.sendall(request.encode())
        self.data = b""
        while b"\r\n\r\n" not in self.data:
            self.read()
        head, _, self.data = self.data.partition(b"\r\n\r\n")
        if b" 101 " not in head.split(b"\r\n")[0]:
            raise OSError("the service answers: " + head.decode())
        self.poll = select.poll()
        self.poll.register(self.socket, select.POLLIN)

    def read(self):
        data = self.socket.recv(2048)
        if not data:
            raise OSError("the service has closed the connection")
        self.data += data

    def send(self, data, opcode=1):
        n = len(data)
        size = bytes([0x80 | n]) if n < 126 else bytes([0xFE, n >> 8, n & 0xFF])
        # A mask must be there, and 0 0 0 0 is one that changes nothing.
        self.socket.sendall(bytes([0x80 | opcode]) + size + b"\0\0\0\0" + data)

    def receive(self, timeout_ms):
        """The next message, None if none has come by then."""
        while len(self.data) < 2 or len(self.data) < self.end():
            if not self.poll.poll(timeout_ms):
                return None
            self.read()
        end, opcode, start = self.end(), self.data[0] & 15, 4 if self.data[1] == 126 else 2
        payload, self.data = self.data[start:end], self.data[end:]
        if opcode == 9:
            self.send(payload, 10)
        return json.loads(payload) if opcode == 1 else None

    def end(self):
        """Where the first frame in `data` ends."""
        n = self.data[1]
        if n < 126:
            return 2 + n
        return 4 + (self.data[2] << 8 | self.data[3]) if len(self.data) >= 4 else 4


def run(service):
    clock = {"unit": "us", "wraps_at": WRAPS_AT}
    hello = {"type": "hello", "robot": ROBOT, "token": TOKEN, "pose_rate_hz": 10, "clock": clock}
    service.send(json.dumps(hello).encode())
    samples, due = [], time.ticks_us()
    while True:
        message = service.receive(max(0, time.ticks_diff(due, time.ticks_us()) // 1000))
        received = time.ticks_us()
        if message is not None:
            if message["type"] == "clock":
                answer = {"type": "clock", "id": message["id"], "received": received, "sent": time.ticks_us()}
                service.send(json.dumps(answer).encode())
            elif message["type"] == "pose":
                steer(message)
            elif message["type"] != "welcome":
                print("the service says:", message)
        if time.ticks_diff(due, received) <= 0:
            samples.append((received,) + read_imu())
            due = time.ticks_add(due, PERIOD_US)
        if len(samples) == BATCH:
            service.send(json.dumps({"type": "imu", "samples": samples}).encode())
            samples = []


while True:
    try:
        run(Service())
    except OSError as error:
        print("no connection, trying again:", error)
        time.sleep(1)
