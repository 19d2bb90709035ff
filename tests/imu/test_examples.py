"""The examples for robots, run against the service as they are, but for the service's address."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from playwright.async_api import async_playwright

from server.app import Service
from tests.server.room import CONFIG, client, fix, run, serving, until
from tests.server.test_page import CHROMIUM, FLAGS

EXAMPLES = Path(__file__).parents[2] / "imu" / "examples"
TOKEN = CONFIG.replace('name = "rover"', 'name = "rover"\ntoken = "its token"')


async def until_it_drives(service: Service, output: list[str]) -> None:
    """Until the robot's samples, clock and pose have all come to where they belong."""
    rover = service.robots["rover"]
    await until(lambda: rover.localiser.counts["imu_samples"] >= 10)
    await until(lambda: rover.clock.minimum_delay is not None)
    rover.feed_fix(fix(), time.monotonic())
    await until(lambda: any("FULL" in line for line in output))
    assert service.refused == 0


@contextlib.asynccontextmanager
async def process(*command: str) -> AsyncIterator[list[str]]:
    """A program and the lines that it prints."""
    running = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT, limit=1 << 20
    )
    lines: list[str] = []

    async def read() -> None:
        assert running.stdout is not None
        while line := await running.stdout.readline():
            lines.append(line.decode())

    reading = asyncio.create_task(read())
    try:
        yield lines
    finally:
        running.kill()
        await running.wait()
        await reading


def javascript(service: Service) -> str:
    text = (EXAMPLES / "robot.js").read_text()
    assert text.count('"ws://127.0.0.1:5678"') == text.count('TOKEN = ""') == 1
    text = text.replace("ws://127.0.0.1:5678", f"ws://127.0.0.1:{service.port}")
    return text.replace('TOKEN = ""', 'TOKEN = "its token"')


@pytest.mark.skipif(not CHROMIUM.exists(), reason=f"{CHROMIUM} is not installed")
def test_javascript_in_a_browser() -> None:
    async def main() -> None:
        async with serving(TOKEN) as service, async_playwright() as playwright:
            chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            try:
                # The policy of the service's own pages allows no other script.
                page = await (await chromium.new_context(bypass_csp=True)).new_page()
                output: list[str] = []
                page.on("console", lambda message: output.append(message.text))
                await page.goto(f"http://127.0.0.1:{service.port}/healthz")
                await page.add_script_tag(content=javascript(service))
                await until_it_drives(service, output)
                assert output[-1].split()[-1] == "FULL"
            finally:
                await chromium.close()

    run(main)


def node() -> list[str] | None:
    """node with a WebSocket of its own, which from version 20 on asks for a word, and from 22 on does not."""
    for command in (["node"], ["node", "--experimental-websocket"]):
        if shutil.which("node") is not None:
            found = subprocess.run([*command, "-p", "typeof WebSocket"], capture_output=True, text=True, timeout=60)
            if found.stdout.strip() == "function":
                return command
    return None


def test_javascript_in_node(tmp_path: Path) -> None:
    command = node()
    if command is None:
        pytest.skip("there is no node with a WebSocket")

    async def main() -> None:
        async with serving(TOKEN) as service:
            (tmp_path / "robot.js").write_text(javascript(service))
            async with process(*command, str(tmp_path / "robot.js")) as output:
                await until_it_drives(service, output)

    run(main)


# What MicroPython's `time` has and Python's has not; the counter of a board of 32 bits, shortly before it wraps.
TICKS = """
import time
origin = time.monotonic_ns() // 1000
time.ticks_us = lambda: (time.monotonic_ns() // 1000 - origin + 2**30 - 100_000) % 2**30
time.ticks_add = lambda ticks, delta: (ticks + delta) % 2**30
time.ticks_diff = lambda a, b: (a - b + 2**29) % 2**30 - 2**29
"""


@pytest.mark.parametrize("interpreter", ["python", "micropython"])
def test_micropython(tmp_path: Path, interpreter: str) -> None:
    text = (EXAMPLES / "robot_micropython.py").read_text()
    assert text.count('HOST, PORT = "192.168.1.10", 5678') == text.count('TOKEN = "rover", ""') == 1
    if interpreter == "micropython" and shutil.which("micropython") is None:
        pytest.skip("micropython is not installed")

    async def main() -> None:
        async with serving(TOKEN) as service:
            program = text.replace('"192.168.1.10", 5678', f'"127.0.0.1", {service.port}')
            program = program.replace('TOKEN = "rover", ""', 'TOKEN = "rover", "its token"')
            (tmp_path / "main.py").write_text((TICKS if interpreter == "python" else "") + program)
            command = [sys.executable, "-u"] if interpreter == "python" else ["micropython"]
            async with process(*command, str(tmp_path / "main.py")) as output:
                await until_it_drives(service, output)
                if interpreter == "python":
                    await until(lambda: service.robots["rover"].localiser.counts["imu_samples"] > 100)
                    assert service.robots["rover"].clock.restarts == 0, "the counter has wrapped meanwhile"

    run(main)


# Feeds the header with the service's messages, and prints its own: what the sketch does between it and the library.
HOST_PROGRAM = """
#include "steadfix_robot.h"
#include <chrono>
#include <poll.h>
#include <string>
#include <unistd.h>

unsigned long microseconds() {
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  // Shortly before it wraps.
  static const auto origin = now;
  return (4294967296ul - 100000ul + std::chrono::duration_cast<std::chrono::microseconds>(now - origin).count()) &
         0xFFFFFFFFul;
}

int main() {
  SteadfixRobot robot("rover", "its token", 20, microseconds);
  puts(robot.hello());
  fflush(stdout);
  std::string waiting;
  for (pollfd input{0, POLLIN, 0};;) {
    if (poll(&input, 1, 5) > 0) {
      char data[4096];
      const ssize_t n = read(0, data, sizeof data);
      if (n <= 0) return 0;
      waiting.append(data, n);
    }
    for (size_t end; (end = waiting.find('\\n')) != std::string::npos; waiting.erase(0, end + 1)) {
      const char* answer = robot.receive(waiting.substr(0, end).c_str());
      if (answer) puts(answer);
      if (robot.mode[0]) fprintf(stderr, "%.3f %.3f %.3f %s\\n", robot.x, robot.y, robot.yaw, robot.mode);
    }
    const char* batch = robot.sample(0.125f, 0, 0, 0, 0, 9.81f);
    if (batch) puts(batch);
    fflush(stdout);
  }
}
"""


def compile_cpp(*arguments: str) -> None:
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-I", str(EXAMPLES / "esp32")]
    subprocess.run([compiler, *flags, *arguments], check=True, timeout=100)


def test_the_esp32s_messages(tmp_path: Path) -> None:
    """The part without the Arduino libraries, compiled here, with a WebSocket around it."""
    (tmp_path / "host.cpp").write_text(HOST_PROGRAM)
    compile_cpp(str(tmp_path / "host.cpp"), "-o", str(tmp_path / "host"))

    async def main() -> None:
        async with serving(TOKEN) as service, client(service, "/v1/robot") as connection:
            pipe = asyncio.subprocess.PIPE
            robot = await asyncio.create_subprocess_exec(tmp_path / "host", stdin=pipe, stdout=pipe, stderr=pipe)
            assert robot.stdin is not None
            assert robot.stdout is not None
            assert robot.stderr is not None
            output: list[str] = []

            async def up() -> None:
                async for line in robot.stdout:
                    await connection.send(line.decode().rstrip())

            async def down() -> None:
                async for message in connection:
                    robot.stdin.write(message.encode() + b"\n")

            async def said() -> None:
                while line := await robot.stderr.readline():
                    output.append(line.decode())

            tasks = [asyncio.create_task(work()) for work in (up, down, said)]
            await until_it_drives(service, output)
            x, y, yaw, mode = output[-1].split()
            assert float(x) == pytest.approx(1.0, abs=0.1)
            assert float(y) == pytest.approx(2.0, abs=0.1)
            assert abs(float(yaw)) < 0.5
            assert mode == "FULL"
            await until(lambda: service.robots["rover"].localiser.counts["imu_samples"] > 60)
            assert service.robots["rover"].clock.restarts == 0, "the counter has wrapped meanwhile"
            robot.kill()
            await robot.wait()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    run(main)


# As much of the Arduino core and of the WebSockets library as the sketch uses, with their signatures.
ARDUINO = """
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
typedef unsigned char byte;
struct SerialPort { void begin(unsigned long); size_t println(const char*); };
extern SerialPort Serial;
unsigned long micros();
void delay(uint32_t);
enum wl_status_t { WL_CONNECTED = 3 };
struct WiFiClass {
  wl_status_t begin(const char*, const char*);
  bool setSleep(bool);
  wl_status_t status();
};
extern WiFiClass WiFi;
typedef enum { WStype_ERROR, WStype_DISCONNECTED, WStype_CONNECTED, WStype_TEXT, WStype_BIN } WStype_t;
struct WebSocketsClient {
  typedef std::function<void(WStype_t type, uint8_t* payload, size_t length)> WebSocketClientEvent;
  void begin(const char* host, uint16_t port, const char* url = "/", const char* protocol = "arduino");
  void loop();
  void onEvent(WebSocketClientEvent event);
  bool sendTXT(const char* payload, size_t length = 0);
  bool isConnected();
  void setReconnectInterval(unsigned long time);
};
"""


def test_the_esp32s_sketch_compiles(tmp_path: Path) -> None:
    """Against stand-ins for the libraries' headers: the toolchain of the ESP32 is not to be had here."""
    for name in ("Arduino.h", "WiFi.h", "WebSocketsClient.h"):
        (tmp_path / name).write_text(ARDUINO if name == "Arduino.h" else '#include "Arduino.h"\n')
    sketch = str(EXAMPLES / "esp32" / "esp32.ino")
    compile_cpp(
        "-Wno-unused-parameter", "-fsyntax-only", "-I", str(tmp_path), "-include", "Arduino.h", "-x", "c++", sketch
    )
