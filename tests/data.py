"""Where the real recordings and photos are. They are not part of the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data(folder: str) -> Path:
    """A folder of the real data; the test is skipped where it is absent."""
    root = os.environ.get("STEADFIX_DATA") or Path(__file__).parents[2] / "shared" / "data"
    path = Path(root) / folder
    if not path.is_dir():
        pytest.skip(f"no real data: {path} is absent; STEADFIX_DATA names the folder that holds {folder}")
    return path
