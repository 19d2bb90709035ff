"""The command `steadfix`. Each subcommand is a module with `add_arguments(parser)` and `run(args) -> exit status`."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

# All matrices here are small: BLAS threads for them only fight over the cores. numpy reads it when it is imported,
# hence this place; a user's own setting stays.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Imported only when asked for: most have no need of the filter, nor `steadfix markers` of a compiler.
COMMANDS = {
    "run": ("server.run", "the service: cameras and IMUs in, poses out; without a configuration a simulated room"),
    "camera": ("server.camera_node", "the node of a remote camera: captures here, for a service elsewhere"),
    "imu": ("server.imu", "what an IMU sends, live, and what is wrong with it"),
    "imu-rest": ("server.imu_rest", "an IMU's bias, scatter and mounting, from ten seconds at rest"),
    "imu-positions": ("server.imu_positions", "an accelerometer's bias and scale, from its six sides"),
    "imu-mounting": ("server.imu_mounting", "how an IMU is turned on its robot, from a recorded drive"),
    "allan": ("server.allan", "an IMU's noise, from hours at rest"),
    "replay": ("server.replay", "run a recording through the filter again"),
    "markers": ("server.markers", "a sheet of markers to print"),
    "board": ("server.board", "a calibration board to print"),
    "calibrate": ("server.calibrate", "a camera's focal length and distortion, from pictures of a board"),
    "floor": ("server.floor", "where the cameras hang, from anchors on the floor"),
    "detect": ("server.detect", "find markers in images"),
}
# Exit status: 1 for what the machine refused, 2 for what the user can put right, as argparse has it.
FAILED, MISUSED, INTERRUPTED, BROKEN_PIPE = 1, 2, 130, 141


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status of the command line `argv`; never raises for what a user or the machine did."""
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        try:
            args = _parser(argv).parse_args(argv)
            status: int = args.run(args)
        finally:
            # Here, where a closed pipe is understood, and not in the interpreter's last moments.
            sys.stdout.flush()
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read the output has seen enough; nothing must be written at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:
        print(f"steadfix: {_words(error)}", file=sys.stderr)
        return FAILED
    except ValueError as error:
        # Ours explain themselves; any other is a mistake of ours and has to be seen whole.
        if type(error).__module__.partition(".")[0] not in ("fusion", "camera", "imu", "server"):
            raise
        print(f"steadfix: {error}", file=sys.stderr)
        return MISUSED
    return status


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="steadfix", description="Where indoor robots are: cameras and IMUs in, poses out."
    )
    parser.add_argument("--version", action="version", version=f"steadfix {version('steadfix')}")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    wanted = next((word for word in argv if not word.startswith("-")), None)
    for name, (module, text) in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name == wanted:
            command = importlib.import_module(module)
            command.add_arguments(subparser)
            subparser.set_defaults(run=command.run)
    return parser


def _words(error: OSError) -> str:
    if error.filename is None:
        return error.strerror or str(error)
    return f"{error.filename}: {(error.strerror or str(error)).lower()}"


def entry() -> NoReturn:
    """The command as a process of its own."""
    status = main()
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    # Not by way of the interpreter's end, which tears daemon threads out of OpenCV's C++: "FATAL: exception not
    # rethrown", seen on a loaded machine. Whatever must be closed has been closed by now.
    os._exit(status)


if __name__ == "__main__":
    entry()
