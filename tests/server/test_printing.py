"""`steadfix markers` and `steadfix board`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.server.command import steadfix


def test_sheets_are_written_where_they_are_wanted(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, text, err = steadfix(capfd, "markers", "--dictionary", "4X4_50", "--ids", "0-11", "--size-mm", 50)
    assert (status, text) == (0, "markers.pdf\n")
    assert "print at 100 %" in err
    assert (tmp_path / "markers.pdf").read_bytes().startswith(b"%PDF")
    status, text, _ = steadfix(capfd, "markers", "--ids", "7, 9-20", "--size-mm", 50, "--out", "sheet.svg")
    assert (status, text) == (0, "sheet-1.svg\nsheet-2.svg\nsheet-3.svg\n")
    status, text, _ = steadfix(capfd, "board", "--board", "chessboard:9x6:25mm", "--out", tmp_path / "b.svg")
    assert (status, text) == (0, f"{tmp_path / 'b.svg'}\n")
    assert steadfix(capfd, "board")[:2] == (0, "board.pdf\n")
    assert steadfix(capfd, "markers", "--ids", "3", "--size-mm", 100, "--paper", "LETTER")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["markers", "--ids", "0-3,2", "--size-mm", "50"], 2, "id 2 is there twice: two sheets with one id"),
        (["markers", "--ids", "5-3", "--size-mm", "50"], 2, "'5-3' is no id and no range of them; 7 and 0-11 are"),
        (["markers", "--ids", "", "--size-mm", "50"], 2, "is no id and no range"),
        (["markers", "--ids", "0-99999", "--size-mm", "50"], 2, "has the ids 0 to 49, not 50\n"),
        (["markers", "--ids", "3", "--size-mm", "0.05"], 2, "'0.05': millimetres are needed, 5 to 2000"),
        (["markers", "--ids", "3", "--size-mm", "nan"], 2, "millimetres are needed"),
        (["markers", "--ids", "3", "--size-mm", "180"], 2, "does not fit on A4: take --paper A3"),
        (["markers", "--ids", "3", "--size-mm", "1900"], 2, "does not fit on A4: take a smaller one"),
        (["markers", "--ids", "3", "--size-mm", "50", "--paper", "A9"], 2, "no paper 'A9'; there are A5, A4"),
        (["markers", "--ids", "3", "--size-mm", "50", "--dictionary", "4X4_51"], 2, "did you mean 4X4_50?"),
        (["markers", "--ids", "3", "--size-mm", "50", "--out", "no/a.pdf"], 1, "no/a.pdf: no such file or directory"),
        (["markers", "--ids", "3", "--size-mm", "50", "--out", "a.doc"], 2, "a.doc: a name that ends in .pdf or .svg"),
        (["board", "--board", "charuco:8x6"], 2, "'charuco:8x6' is no board"),
        (["board", "--board", "chessboard:9x6:40mm"], 2, "does not fit on A4: take --paper A2"),
    ],
)
def test_what_cannot_be_printed_says_what_can(
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    status: int,
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    found, text, err = steadfix(capfd, *arguments)
    assert says in err
    assert (found, text) == (status, "")
    assert list(tmp_path.iterdir()) == []
