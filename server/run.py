"""`steadfix run`: the service from the command line, with a configuration or in front of the demo room."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from pathlib import Path

import cv2
import msgspec

from server.app import SERVICE, Service
from server.config import Config, ConfigError, load
from server.demo.room import DemoRoom
from server.listening import port_number, reachable
from server.recording import Recorder
from server.terminal import log_to_stderr, stop_signals


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", nargs="?", metavar="CONFIG.toml", help="without it: a simulated room to look at")
    parser.add_argument("--host", help="address to listen on, instead of the configured one")
    parser.add_argument(
        "--port",
        type=port_number,
        metavar="PORT",
        help="port to listen on, instead of the configured one; 0 for any free one",
    )
    parser.add_argument(
        "--remote-camera", action="store_true", help="the simulated room's camera in a process of its own, as on a Pi"
    )
    parser.add_argument("--light", type=_light, metavar="L", help="of the simulated room: 1 is well lit, 0.1 is dusk")
    parser.add_argument("--record", type=Path, metavar="FOLDER", help="keep all inputs there, for `steadfix replay`")


def _light(text: str) -> float:
    try:
        light = float(text)
    except ValueError:
        light = -1.0
    if not 0.0 <= light <= 2.0:
        raise argparse.ArgumentTypeError(f"{text!r} is no light, 0 to 2 are")
    return light


def run(args: argparse.Namespace) -> int:
    if args.config is not None and (args.remote_camera or args.light is not None):
        raise ConfigError("--remote-camera and --light are for the simulated room, which is there without CONFIG.toml")
    log_to_stderr()
    # One thread for each camera is what keeps several of them fast.
    cv2.setNumThreads(1)
    return asyncio.run(_run(args))


async def _run(args: argparse.Namespace) -> int:
    stop = stop_signals()
    if args.config is not None:
        await _serve_until(stop, load(args.config), args)
        return 0
    room = DemoRoom(remote_camera=args.remote_camera, light=1.0 if args.light is None else args.light)
    try:
        await _serve_until(stop, room.config(), args, room)
    finally:
        room.stop()
    print(room.report(), flush=True)
    return 0


async def _serve_until(
    stop: asyncio.Event, config: Config, args: argparse.Namespace, room: DemoRoom | None = None
) -> None:
    changes = {key: value for key in ("host", "port") if (value := getattr(args, key)) is not None}
    config = msgspec.structs.replace(config, server=msgspec.structs.replace(config.server, **changes))
    async with contextlib.AsyncExitStack() as stack:
        recorder = None
        if args.record is not None:
            imus = {robot.name: robot.imu for robot in config.robot}
            recorder = stack.enter_context(contextlib.closing(Recorder(args.record, imus, imus)))
        if room is None:
            service = Service(config, recorder)
        else:
            # Nobody must write the truth to a recording that is closed.
            stack.callback(room.stop)
            room.record_truth = recorder.truth if recorder is not None else None
            service = Service(config, recorder, room.open_camera, room.score)
        await stack.enter_async_context(service)
        address = f"{reachable(config.server.host)}:{service.port}"
        if room is not None:
            room.start(f"ws://{address}")
        scheme = "https" if config.server.certificate else "http"
        print(f"{SERVICE}: {scheme}://{address}/", flush=True)
        stopped = asyncio.create_task(stop.wait())
        await asyncio.wait((stopped, service.failed), return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        if service.failed.done():
            service.failed.result()
