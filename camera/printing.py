"""Sheets to print, as PDF or SVG, to scale: markers to cut out or to lie on the floor, and calibration boards.

Everything is drawn in millimetres on a page of the paper's size. Black cells of one marker are one filled path, so that
no viewer or printer shows hairlines between them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import FigureCanvasPdf, PdfPages
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from camera.boards import Board
from camera.dictionaries import dictionary_by_name
from fusion.measurements import Array

# Width and height, mm
PAPERS = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
# What most printers leave white along the paper's edge, mm
_EDGE = 5.0
# Around a marker's white margin: ticks at the middles of its sides, to measure from; below it what it is. mm
_FRAME, _STRIP = 3.0, 9.0
# At the bottom of each page: the ruler and what to do with it. mm
_FOOT = 16.0
_RULER = 100.0
_POINT = 25.4 / 72.0
_GREY = "0.45"


class PrintError(ValueError):
    """A sheet that cannot be made. The text says what would be right."""


def print_markers(
    path: str | os.PathLike[str], dictionary: str, ids: Sequence[int], size: float, paper: str = "A4"
) -> list[Path]:
    """Draws markers with the side `size` (m) of the black square, as many on a page as fit. Returns the files written:
    one PDF, or an SVG for each page.

    Each has a white margin of one cell, ticks at the middles of its sides, its id and its axes. Raises PrintError if
    the paper is too small, DictionaryError, ValueError for an id that the dictionary does not have, OSError.
    """
    found = dictionary_by_name(dictionary)
    there = len(found.bytesList)
    unknown = next((id for id in ids if not 0 <= id < there), None)
    if unknown is not None:
        raise PrintError(f"{dictionary} has the ids 0 to {there - 1}, not {unknown}")
    side = 1e3 * size
    margin = side / (found.markerSize + 2)
    width, height = _paper(paper)
    wide, high = side + 2.0 * (margin + _FRAME), side + 2.0 * (margin + _FRAME) + _STRIP
    across = math.floor((width - 2.0 * _EDGE + 2.0 * _FRAME) / wide)
    down = math.floor((height - 2.0 * _EDGE - _FOOT) / high)
    if across < 1 or down < 1:
        least = next((name for name, sizes in PAPERS.items() if _fits(wide, high, *sizes)), None)
        advice = f"--paper {least}" if least else "a smaller one"
        raise PrintError(
            f"a marker of {side:g} mm with its white margin of {margin:.3g} mm does not fit on {paper}: take {advice}"
        )
    left, top = 0.5 * (width - across * wide), height - _EDGE

    def page(some: Sequence[int]) -> Callable[[Axes], None]:
        def draw(axes: Axes) -> None:
            for k, id in enumerate(some):
                corner = left + k % across * wide, top - (k // across + 1) * high
                _marker(axes, found, dictionary, id, side, margin, corner)
            _foot(axes, f"{dictionary}, {side:g} mm: black edge to black edge, across and down")

        return draw

    ids = list(ids)
    pages = [page(ids[k : k + across * down]) for k in range(0, len(ids), across * down)]
    return _write(Path(path), (width, height), pages)


def print_board(path: str | os.PathLike[str], board: Board, paper: str = "A4") -> list[Path]:
    """Draws a calibration board in the middle of a page. Returns the files written. Raises PrintError if the paper is
    too small, and OSError."""
    square = 1e3 * board.square
    wide, high = (square * n for n in board.squares)
    sheet = next((s for s in (_paper(paper), _paper(paper)[::-1]) if _holds(wide, high, *s)), None)
    if sheet is None:
        least = next(
            (name for name, (w, h) in PAPERS.items() if _holds(wide, high, w, h) or _holds(wide, high, h, w)), ""
        )
        advice = f"take --paper {least}" if least else "take smaller squares"
        raise PrintError(f"{board} is {wide:g} x {high:g} mm and does not fit on {paper}: {advice}, or fewer squares")
    left, bottom = 0.5 * (sheet[0] - wide), _FOOT + 0.5 * (sheet[1] - _FOOT - high)

    def draw(axes: Axes) -> None:
        across, down = board.squares
        black = np.add.outer(np.arange(down), np.arange(across)) % 2 == 0
        axes.add_patch(_cells(black, left, bottom, square))
        if board.kind == "charuco":
            drawn = board.opencv()
            dictionary = dictionary_by_name(board.dictionary)
            for id, corners in zip(np.asarray(drawn.getIds()).ravel(), drawn.getObjPoints(), strict=True):
                # y of a board points down; the last corner is the bottom left one.
                x, y = 1e3 * np.asarray(corners)[3, :2]
                cell = 1e3 * board.marker / (dictionary.markerSize + 2)
                axes.add_patch(_cells(_black(dictionary, int(id)), left + x, bottom + high - y, cell))
        _foot(axes, f"steadfix calibrate --board {board}")

    return _write(Path(path), sheet, [draw])


def _paper(name: str) -> tuple[float, float]:
    by_name = {paper.lower(): size for paper, size in PAPERS.items()}
    if name.lower() not in by_name:
        raise PrintError(f"no paper {name!r}; there are {', '.join(PAPERS)}")
    return by_name[name.lower()]


def _fits(wide: float, high: float, width: float, height: float) -> bool:
    """A framed marker on a page: of the frame only the ticks may fall to the paper's edge."""
    return wide - 2.0 * _FRAME <= width - 2.0 * _EDGE and high <= height - 2.0 * _EDGE - _FOOT


def _holds(wide: float, high: float, width: float, height: float) -> bool:
    """A board on a page."""
    return wide <= width - 2.0 * _EDGE and high <= height - _EDGE - _FOOT


def _write(path: Path, size: tuple[float, float], pages: Sequence[Callable[[Axes], None]]) -> list[Path]:
    kind = path.suffix.lower()
    if kind not in (".pdf", ".svg"):
        raise PrintError(f"{path}: a name that ends in .pdf or .svg is needed")
    if kind == ".pdf":
        with closing(PdfPages(path, metadata={"Creator": "Steadfix", "CreationDate": None})) as file:
            for figure in _figures(size, pages):
                FigureCanvasPdf(figure)
                file.savefig(figure)  # type: ignore[no-untyped-call]
        return [path]
    paths = [path] if len(pages) == 1 else [path.with_stem(f"{path.stem}-{k + 1}") for k in range(len(pages))]
    for name, figure in zip(paths, _figures(size, pages), strict=True):
        FigureCanvasSVG(figure)
        figure.savefig(name, format="svg", metadata={"Creator": "Steadfix", "Date": None})
    return paths


def _figures(size: tuple[float, float], pages: Sequence[Callable[[Axes], None]]) -> Iterator[Figure]:
    """One for each page, its coordinates in mm from the bottom left."""
    for draw in pages:
        figure = Figure(figsize=(size[0] / 25.4, size[1] / 25.4))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set_xlim(0.0, size[0])
        axes.set_ylim(0.0, size[1])
        draw(axes)
        yield figure


def _marker(
    axes: Axes,
    dictionary: cv2.aruco.Dictionary,
    name: str,
    id: int,
    side: float,
    margin: float,
    corner: tuple[float, float],
) -> None:
    """One marker with its frame and strip; `corner`: bottom left, mm."""
    left, bottom = corner[0] + _FRAME + margin, corner[1] + _STRIP + _FRAME + margin
    black = _black(dictionary, id)
    axes.add_patch(_cells(black, left, bottom, side / len(black)))
    x, y, half, reach = left + 0.5 * side, bottom + 0.5 * side, 0.5 * side + margin, 0.5 * side + margin + _FRAME
    for way in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        _line(axes, [(x + way[0] * part, y + way[1] * part) for part in (half, reach)])
    # Cut here: outside the ticks, below the strip
    _line(
        axes,
        [
            (x - reach, y + reach), (x + reach, y + reach), (x + reach, corner[1]), (x - reach, corner[1]),
            (x - reach, y + reach),
        ],
        style=(0, (2, 4)),
    )  # fmt: skip
    # Its axes: what points to the top of the paper is north, y, where yaw_deg is 0.
    origin = (x - half, corner[1] + 1.5)
    for (dx, dy), label in (((6.0, 0.0), "x"), ((0.0, 6.0), "N")):
        axes.annotate(
            "", (origin[0] + dx, origin[1] + dy), origin, arrowprops={"arrowstyle": "-|>", "lw": 0.7, "color": "black"}
        )  # fmt: skip
        axes.text(origin[0] + 1.1 * dx + 0.15 * dy, origin[1] + 0.15 * dx + 0.9 * dy, label, fontsize=6, va="center")
    text = f"{name}  id {id}  {side:g} mm"
    room = 2.0 * half - 9.5
    # A letter is about 0.6 of its height wide.
    axes.text(origin[0] + 9.0, corner[1] + 3.0, text, fontsize=min(10.0, room / (0.6 * len(text) * _POINT)))


def _foot(axes: Axes, text: str) -> None:
    """The ruler, and what the page is."""
    left, y = 15.0, _EDGE + 2.0
    _line(axes, [(left, y), (left + _RULER, y)], colour="black")
    for k in range(int(_RULER) + 1):
        high = 3.0 if k % 10 == 0 else 2.0 if k % 5 == 0 else 1.0
        _line(axes, [(left + k, y), (left + k, y + high)], colour="black")
    for k in range(0, int(_RULER) + 1, 50):
        axes.text(left + k, y + 3.6, f"{k}", fontsize=6, ha="center")
    axes.text(
        left + _RULER + 4.0, y + 2.2, f"Measure: 0 to {_RULER:.0f} mm. Else print at 100 %, not fitted.", fontsize=7
    )
    axes.text(left + _RULER + 4.0, y - 0.8, text, fontsize=7)


def _line(
    axes: Axes,
    points: Sequence[tuple[float, float]],
    style: tuple[int, tuple[int, ...]] | str = "-",
    colour: str = _GREY,
) -> None:
    axes.plot(*zip(*points, strict=True), linestyle=style, linewidth=0.4, color=colour, solid_capstyle="butt")


def _black(dictionary: cv2.aruco.Dictionary, id: int) -> NDArray[np.bool_]:
    """(cells, cells) of a marker, its border included."""
    cells = dictionary.markerSize + 2
    return np.equal(cv2.aruco.generateImageMarker(dictionary, id, cells), 0)


def _cells(black: NDArray[np.bool_], left: float, bottom: float, cell: float) -> PathPatch:
    """The black cells of a grid, row 0 at the top, as one filled path."""
    rows = len(black)
    outlines: list[Array] = []
    for row, line in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        for start, end in edges.reshape(-1, 2):
            x = left + cell * np.array([start, end, end, start, start])
            y = bottom + cell * (rows - row - np.array([1, 1, 0, 0, 1]))
            outlines.append(np.stack([x, y], axis=1))
    codes = [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY]
    path = Outline(np.concatenate(outlines), codes * len(outlines))
    return PathPatch(path, facecolor="black", edgecolor="none", linewidth=0.0)
