"""The way of the imports: server -> {camera, imu} -> fusion; and each outside library behind its own door."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "fusion": {"fusion"},
    "camera": {"camera", "fusion"},
    "imu": {"imu", "fusion"},
    "server": {"server", "camera", "imu", "fusion"},
}
# Who may import what is not to spread.
DOORS = {
    "picamera2": {"camera/picamera.py"},
    "libcamera": {"camera/picamera.py"},
    "serial": {"imu/uart.py"},
    "pymavlink": {"imu/protocols/mavlink.py"},
    "websockets": {
        "server/listening.py",
        "server/calibration_page.py",
        "server/app.py",
        "server/door.py",
        "server/visitor.py",
        "server/connecting.py",
        "server/robot_client.py",
        "server/remote_cameras.py",
        "server/camera_node.py",
    },
    "filterpy": {"fusion/reference.py"},
    "allantools": {"imu/allan.py"},
    "numba": {"fusion/kernels.py", "camera/edges.py", "camera/planar.py"},
}
# `fusion` is pure: time and data are arguments, and it returns instead of saying anything.
IMPURE = {"asyncio", "logging", "os", "pathlib", "socket", "subprocess", "threading", "time", "datetime"}
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def imports(path: Path) -> Iterator[str]:
    """The dotted names that a module imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            assert node.module is not None
            yield node.module


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_imports_go_one_way(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    for imported in imports(path):
        top = imported.partition(".")[0]
        assert top not in PACKAGES or top in PACKAGES[package], f"{package} must not import {imported}"
        assert top not in DOORS or name(path) in DOORS[top], f"{imported} is for {', '.join(DOORS[top])} alone"
        assert package != "fusion" or top not in IMPURE, f"fusion is pure, and {imported} is not"
        assert top not in ("tests", "notebooks", "benchmarks")


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_no_module_bears_the_name_of_a_library(path: Path) -> None:
    libraries = {imported.partition(".")[0] for module in MODULES for imported in imports(module)} - set(PACKAGES)
    assert path.stem == "__init__" or path.stem not in libraries | set(sys.stdlib_module_names)


def test_the_doors_are_used() -> None:
    """A door nobody goes through has been walled up and forgotten here."""
    through = {(top, name(path)) for path in MODULES for top in {found.partition(".")[0] for found in imports(path)}}
    for library in ("serial", "pymavlink", "websockets", "filterpy", "numba", "picamera2", "allantools"):
        for door in DOORS[library]:
            if (ROOT / door).exists():
                assert (library, door) in through
