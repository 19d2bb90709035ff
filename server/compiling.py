"""Compiling the kernels, as fast as the machine can, and saying so."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path

from fusion import kernels
from fusion.localiser import warm_up
from fusion.params import Engine

# Loading takes a moment, compiling a while: after so many s that needs an explanation.
PATIENCE = 3.0
NOTICE = "compiling the filters; this happens once after each update and may take a minute"


# For other interpreters: in each numba compiles one thing at a time, and all find it in its cache.
_MOVING = "from fusion import kernels; kernels.compile_moving()"
_CAMERA = "from camera import edges, planar; edges.warm_up(); planar.warm_up()"


def load_or_compile(engine: Engine = "numba", *, camera: bool = False) -> None:
    """`warm_up`, with the help of other interpreters; `camera`: one of them sees to the camera's kernels meanwhile."""
    if engine == "numba" and (os.cpu_count() or 1) > 1 and not _in_cache():
        with contextlib.ExitStack() as beside:
            for work in (_MOVING, _CAMERA) if camera else (_MOVING,):
                command = [sys.executable, "-c", work]
                beside.enter_context(subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
            kernels.compile_taking()
    warm_up(engine)


def _in_cache() -> bool:
    """Whether numba has compiled the kernels since they were last changed."""
    source = Path(kernels.__file__)
    written = Path(kernels.process.stats.cache_path).glob(f"{source.stem}.{kernels.process.__name__}-*.nbi")
    return any(index.stat().st_mtime > source.stat().st_mtime for index in written)


def compile_filter() -> None:
    """On a thread of its own: here a Ctrl-C could fall into a callback of the compiler, which swallows it."""
    errors: list[Exception] = []

    def work() -> None:
        try:
            load_or_compile()
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=work, name="warm-up", daemon=True)
    thread.start()
    thread.join(PATIENCE)
    if thread.is_alive():
        print(f"steadfix: {NOTICE}", file=sys.stderr)
    thread.join()
    if errors:
        raise errors[0]
