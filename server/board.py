"""`steadfix board`: a calibration board to print."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from camera.boards import DEFAULT_BOARD, parse_board
from camera.printing import PAPERS, PrintError, print_board


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument(
        "--board",
        default=DEFAULT_BOARD,
        metavar="BOARD",
        help="chessboard:9x6:25mm has 9 x 6 inner corners, charuco:8x6:30mm has 8 x 6 squares (default: %(default)s)",
    )
    parser.add_argument("--paper", default="A4", metavar="NAME", help=f"one of {', '.join(PAPERS)}")
    parser.add_argument("--out", default="board.pdf", type=Path, metavar="FILE", help=".pdf or .svg")


def run(args: argparse.Namespace) -> int:
    """Runs the command. Returns 0, or 2 for arguments that cannot be followed. Raises BoardError, OSError."""
    board = parse_board(args.board)
    try:
        files = print_board(args.out, board, args.paper)
    except PrintError as error:
        sys.stderr.write(f"steadfix board: {error}\n")
        return 2
    print(*files, sep="\n")
    sys.stderr.write(
        "steadfix board: print at 100 %, on matte paper; measure the ruler, and glue it on something flat and stiff\n"
    )
    return 0
