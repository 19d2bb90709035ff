"""The command: what it says, and how it ends. Each in a process of its own, as a user has it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONFIG = """
[server]
port = 0
[[robot]]
name = "rover"
marker = [{id = 7, size_mm = 60}]
"""
COMMAND = [sys.executable, "-m", "server.cli"]


def steadfix(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=100)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "room.toml"
    path.write_text(CONFIG)
    return path


def test_version() -> None:
    answer = steadfix("--version")
    assert (answer.returncode, answer.stdout) == (0, f"steadfix {version('steadfix')}\n")


@pytest.mark.parametrize("arguments", [[], ["frobnicate"], ["run", "--frobnicate"], ["run", "--port", "70000"]])
def test_a_command_line_that_is_wrong(arguments: list[str]) -> None:
    answer = steadfix(*arguments)
    assert answer.returncode == 2
    assert answer.stderr.startswith("usage: steadfix")
    assert "Traceback" not in answer.stderr


@pytest.mark.parametrize(
    ("text", "status", "expected"),
    [
        (None, 1, "room.toml: no such file or directory"),
        ("[server]\nprot = 1", 2, 'room.toml, line 2: server, prot: unknown key; did you mean "port"'),
        ("[server", 2, "room.toml: not valid TOML"),
        (
            CONFIG + '[[camera]]\nname = "c"\nsource = 0\ncalibration = "none.toml"\n'
            "[[anchor]]\nid = 1\nsize_mm = 100\nposition_m = [0, 0, 0]\n",
            2,
            "there is no calibration file",
        ),
    ],
)
def test_a_configuration_that_is_wrong(tmp_path: Path, text: str | None, status: int, expected: str) -> None:
    path = tmp_path / "room.toml"
    if text is not None:
        path.write_text(text)
    answer = steadfix("run", str(path))
    assert answer.returncode == status
    assert answer.stderr.startswith("steadfix: ")
    assert expected in answer.stderr
    assert len(answer.stderr.splitlines()) == 1
    assert answer.stdout == ""


def test_a_port_in_use(config: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        answer = steadfix("run", str(config), "--port", str(port))
    assert answer.returncode == 1
    assert answer.stderr.startswith(f"steadfix: port {port} on 127.0.0.1 is in use")
    assert len(answer.stderr.splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_service_says_where_it_is_and_ends_when_it_is_told(config: Path, number: signal.Signals) -> None:
    with subprocess.Popen(
        [*COMMAND, "run", str(config)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as service:
        try:
            assert service.stdout is not None
            address = service.stdout.readline()
            assert address.startswith(f"steadfix {version('steadfix')}: http://127.0.0.1:")
            service.send_signal(number)
            _, errors = service.communicate(timeout=60)
            assert service.returncode == 0
            assert "Traceback" not in errors
        finally:
            service.kill()


def test_a_closed_pipe() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        answer = subprocess.run(
            [*COMMAND, "run", "--help"], cwd=ROOT, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=100
        )
    # 0 where the output is not buffered: argparse itself passes over it then.
    assert answer.returncode in (0, 141)
    assert answer.stderr == ""


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        ("detect", "fusion.kernels"),
        ("camera", "fusion.kernels"),
        ("markers", "numba"),
        ("board", "numba"),
        ("calibrate", "numba"),
        ("--version", "numpy"),
    ],
)
def test_what_a_command_does_not_need_is_not_imported(arguments: str, absent: str) -> None:
    script = (
        "import sys, server.cli\n"
        "try: server.cli.main(sys.argv[1:])\n"
        f"except SystemExit: print('{absent}' in sys.modules, file=sys.stderr)\n"
    )
    answer = subprocess.run(
        [sys.executable, "-c", script, arguments, "--help"], cwd=ROOT, capture_output=True, text=True, timeout=100
    )
    assert answer.stderr == "False\n"
