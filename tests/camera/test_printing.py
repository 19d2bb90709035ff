"""Sheets, measured on the page as it would come out of the printer."""

import cv2
import numpy as np
import pypdfium2
import pytest

from camera.boards import BoardDetector, parse_board
from camera.dictionaries import DictionaryError
from camera.markers import MarkerDetector
from camera.printing import PAPERS, PrintError, print_board, print_markers

DPI = 300
PX_PER_MM = DPI / 25.4


def printed(path):
    """The pages of a PDF at DPI, grey."""
    with pypdfium2.PdfDocument(path) as document:
        return [page.render(scale=DPI / 72.0, grayscale=True).to_numpy() for page in document]


def sides_mm(corners_px):
    return np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1) / PX_PER_MM


def longest_black_mm(line):
    """The longest run of dark pixels."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], (line < 128).astype(int), [0]])))
    return (ends[1::2] - ends[::2]).max() / PX_PER_MM


def test_markers_have_their_size_id_and_margin(tmp_path):
    (path,) = print_markers(tmp_path / "markers.pdf", "4X4_50", range(12), 0.05)
    pages = printed(path)
    assert len(pages) == 2
    np.testing.assert_allclose([page.shape for page in pages], np.multiply((297, 210), PX_PER_MM) * [[1], [1]], atol=1)
    ids = []
    for page in pages:
        for sighting in MarkerDetector("4X4_50").search(page):
            ids.append(sighting.id)
            # pdfium moves edges to whole pixels
            np.testing.assert_allclose(sides_mm(sighting.corners_px), 50.0, atol=1.5 / PX_PER_MM)
            (left, top), _, (right, bottom), _ = sighting.corners_px
            assert left < right
            assert top < bottom  # upright
            margin = 50.0 / 6.0 * PX_PER_MM - 2.0
            around = page[
                round(top - margin) : round(bottom + margin) + 1, round(left - margin) : round(right + margin) + 1
            ].copy()
            inside = round(margin) - 2
            around[inside:-inside, inside:-inside] = 255
            assert around.min() == 255  # the white margin of one cell is white
    assert sorted(ids) == list(range(12))


def test_cells_have_no_hairlines_between_them(tmp_path):
    (page,) = printed(*print_markers(tmp_path / "one.pdf", "4X4_50", [17], 0.1))
    (sighting,) = MarkerDetector("4X4_50", [17]).search(page)
    left, top = np.ceil(sighting.corners_px.min(axis=0)).astype(int) + 2
    right, bottom = np.floor(sighting.corners_px.max(axis=0)).astype(int) - 2
    inside = page[top:bottom, left:right]
    # Only where black meets white is there anything in between: at most two pixels for each edge that a line crosses.
    between = (inside > 10) & (inside < 245)
    assert np.median(between.sum(axis=1)) <= 8
    assert between[:80].sum() == 0  # the black border


def test_the_largest_anchor_that_a4_takes(tmp_path):
    (page,) = printed(*print_markers(tmp_path / "anchor.pdf", "4X4_50", [40], 0.15))
    (sighting,) = MarkerDetector("4X4_50").search(cv2.resize(page, None, fx=0.2, fy=0.2, interpolation=cv2.INTER_AREA))
    assert sighting.id == 40
    for line in (page[round(40.0 * PX_PER_MM)], page[:, round(40.0 * PX_PER_MM)]):  # along its black border
        assert longest_black_mm(line) == pytest.approx(150.0, abs=1.5 / PX_PER_MM)
    with pytest.raises(PrintError, match=r"180 mm .* does not fit on A4: take --paper A3"):
        print_markers(tmp_path / "anchor.pdf", "4X4_50", [40], 0.18)


@pytest.mark.parametrize("paper", ["A4", "letter", "A3"])
def test_the_ruler_has_its_length(tmp_path, paper):
    (page,) = printed(*print_markers(tmp_path / "ruler.pdf", "4X4_50", [1], 0.03, paper))
    width, height = PAPERS[paper]
    assert abs(page.shape[1] - width * PX_PER_MM) <= 1.0
    # The line itself, 7 mm above the lower edge; the text beside it begins 4 mm further right.
    line = page[round((height - 7.0) * PX_PER_MM), : round(118.0 * PX_PER_MM)]
    assert longest_black_mm(line) == pytest.approx(100.0, abs=0.2)


@pytest.mark.parametrize("spec", ["charuco:8x6:30mm", "charuco:7x9:20mm:15mm:4X4_100", "chessboard:9x6:25mm"])
def test_boards_are_found_and_have_their_size(tmp_path, spec):
    board = parse_board(spec)
    (path,) = print_board(tmp_path / "board.pdf", board)
    (page,) = printed(path)
    view = BoardDetector(board).find(page)
    assert view is not None
    assert len(view.indices) == len(board.corners)
    scale, _ = cv2.estimateAffinePartial2D(board.corners[view.indices, :2], view.corners_px)
    at = board.corners[view.indices, :2] @ scale[:, :2].T + scale[:, 2]
    np.testing.assert_allclose(at, view.corners_px, atol=0.5)
    assert np.linalg.norm(scale[:, 0]) == pytest.approx(1000.0 * PX_PER_MM, rel=5e-4)
    assert np.linalg.det(scale[:, :2]) > 0.0  # not mirrored


def test_svg_has_the_size_of_the_page_and_a_file_for_each(tmp_path):
    paths = print_markers(tmp_path / "sheet.svg", "APRILTAG_36H11", range(10), 0.05)
    assert [path.name for path in paths] == ["sheet-1.svg", "sheet-2.svg"]
    text = paths[0].read_text()
    # 210 x 297 mm in points
    assert 'width="595.275591pt" height="841.889764pt"' in text
    (path,) = print_board(tmp_path / "board.svg", parse_board("chessboard:9x6:25mm"))
    assert path.name == "board.svg"


def test_what_cannot_be_printed_says_what_can(tmp_path):
    with pytest.raises(PrintError, match="ids 0 to 49, not 50"):
        print_markers(tmp_path / "a.pdf", "4X4_50", [3, 50], 0.05)
    with pytest.raises(PrintError, match=r"a\.png: a name that ends in \.pdf or \.svg"):
        print_markers(tmp_path / "a.png", "4X4_50", [3], 0.05)
    with pytest.raises(PrintError, match="no paper 'A9'; there are A5, A4"):
        print_markers(tmp_path / "a.pdf", "4X4_50", [3], 0.05, "A9")
    with pytest.raises(PrintError, match=r"400 x 280 mm and does not fit on A4: take --paper A2"):
        print_board(tmp_path / "a.pdf", parse_board("chessboard:9x6:40mm"))
    with pytest.raises(PrintError, match="take smaller squares, or fewer"):
        print_board(tmp_path / "a.pdf", parse_board("chessboard:9x6:400mm"))
    with pytest.raises(DictionaryError, match="did you mean 4X4_50"):
        print_markers(tmp_path / "a.pdf", "4X4_51", [3], 0.05)
    assert list(tmp_path.iterdir()) == []
