"""`steadfix markers`: a sheet of markers to print."""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from pathlib import Path

from camera.dictionaries import DICTIONARIES, DictionaryError
from camera.printing import PAPERS, PrintError, print_markers


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("--dictionary", default="4X4_50", metavar="NAME", help=f"one of {', '.join(DICTIONARIES)}")
    parser.add_argument("--ids", required=True, type=_ids, metavar="IDS", help="such as 0-11 or 7,8,40-43")
    parser.add_argument("--size-mm", required=True, type=_size, metavar="S", help="side of the black square")
    parser.add_argument("--paper", default="A4", metavar="NAME", help=f"one of {', '.join(PAPERS)}")
    parser.add_argument(
        "--out", default="markers.pdf", type=Path, metavar="FILE", help=".pdf, or .svg (a file for each page)"
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command. Returns 0, or 2 for arguments that cannot be followed. Raises OSError."""
    try:
        files = print_markers(args.out, args.dictionary, args.ids, args.size_mm / 1000.0, args.paper)
    except DictionaryError as error:
        sys.stderr.write(f"steadfix markers: --dictionary: {error}\n")
        return 2
    except PrintError as error:
        sys.stderr.write(f"steadfix markers: {error}\n")
        return 2
    print(*files, sep="\n")
    sys.stderr.write(
        "steadfix markers: print at 100 %, on matte paper; measure the ruler, and give the black square's side, as "
        "measured, as size_mm\n"
    )
    return 0


def _ids(text: str) -> list[int]:
    ids: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,5})\s*(?:-\s*(\d{1,5})\s*)?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if last < first:
            raise argparse.ArgumentTypeError(f"{part!r} is no id and no range of them; 7 and 0-11 are")
        ids += range(first, last + 1)
    twice = [id for id, count in Counter(ids).items() if count > 1]
    if twice:
        raise argparse.ArgumentTypeError(
            f"id {twice[0]} is there twice: two sheets with one id cannot be told apart, on robots or on the floor"
        )
    return ids


def _size(text: str) -> float:
    try:
        size = float(text)
    except ValueError:
        size = 0.0
    if not 5.0 <= size <= 2000.0:
        raise argparse.ArgumentTypeError(f"{text!r}: millimetres are needed, 5 to 2000")
    return size
