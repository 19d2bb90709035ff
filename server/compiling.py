"""Compiling the filter, as fast as the machine can, and saying so."""

from __future__ import annotations

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


def load_or_compile(engine: Engine = "numba") -> None:
    """`warm_up`, with the help of a second interpreter, as numba compiles one thing at a time in each."""
    if engine == "numba" and (os.cpu_count() or 1) > 1 and not _in_cache():
        beside = [sys.executable, "-c", "from fusion import kernels; kernels.compile_moving()"]
        with subprocess.Popen(beside, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL):
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
