"""The filter compiled by two processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

AHEAD = ["_take", "_run_to", "_next_sample", "_watch", "_absorb", "_insert_fix", "_write_pose", "_move", "_grid"]


@pytest.mark.long
def test_what_is_compiled_ahead_is_what_the_filter_calls(tmp_path: Path) -> None:
    """A signature of its own would be compiled beside the one that is called, and lie in the cache as another file."""
    code = "from server.compiling import _in_cache, load_or_compile; assert not _in_cache(); load_or_compile(); "
    code += "assert _in_cache()"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    compiled = Counter(path.name.split(".")[1].rpartition("-")[0] for path in tmp_path.rglob("kernels.*.nbc"))
    assert {name: compiled[name] for name in AHEAD} == dict.fromkeys(AHEAD, 1)
