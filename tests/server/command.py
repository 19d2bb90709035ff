"""The command in a test's own process."""

from __future__ import annotations

import pytest

from server import cli


def steadfix(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, output and standard error."""
    try:
        status = cli.main([str(argument) for argument in arguments])
    except SystemExit as usage:
        status = int(usage.code or 0)
    output = capfd.readouterr()
    assert "Traceback" not in output.err
    return status, output.out, output.err
