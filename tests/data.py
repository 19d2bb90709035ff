"""The real recordings and photographs that tests are held against; they are not part of the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data(folder: str) -> Path:
    """A folder of the real data: under STEADFIX_DATA, else beside the repository. Skips the test without it."""
    root = Path(os.environ.get("STEADFIX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if not (root / folder).is_dir():
        pytest.skip(f"no real data: {root / folder} is absent (set STEADFIX_DATA)")
    return root / folder
