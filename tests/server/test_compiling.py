"""The filter compiled by two processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

AHEAD = ["_take", "_run_to", "_next_sample", "_watch", "_absorb", "_insert_fix", "_write_pose", "_move", "_grid"]
A_PICTURE_TO_A_FIX = "tests/server/test_cameras.py::test_a_blurred_marker_is_followed_where_the_filter_predicts_it"


@pytest.mark.long
def test_what_is_compiled_ahead_is_what_is_called(tmp_path: Path) -> None:
    """A signature of its own would be compiled beside the one that is called, and lie in the cache as another file."""
    code = "from server.compiling import _in_cache, load_or_compile; assert not _in_cache(); "
    code += "load_or_compile(camera=True); assert _in_cache()"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    before = Counter(path.name for path in tmp_path.rglob("*.nbc"))
    subprocess.run([sys.executable, "-m", "pytest", "-q", A_PICTURE_TO_A_FIX], env=environment, check=True)
    assert Counter(path.name for path in tmp_path.rglob("*.nbc")) == before
    compiled = Counter(name.split(".")[1].rpartition("-")[0] for name in before if name.startswith("kernels."))
    assert {name: compiled[name] for name in AHEAD} == dict.fromkeys(AHEAD, 1)
    assert {"edges._refine", "planar._solve"} <= {name.rpartition("-")[0] for name in before}
