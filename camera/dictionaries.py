"""The marker dictionaries that there are, by name."""

from __future__ import annotations

import difflib

import cv2

# 4X4_50 ... 7X7_1000, APRILTAG_16H5 ... APRILTAG_36H11, ARUCO_MIP_36H12, ARUCO_ORIGINAL
DICTIONARIES = tuple(sorted({name.removeprefix("DICT_").upper() for name in dir(cv2.aruco) if name[:5] == "DICT_"}))


class DictionaryError(ValueError):
    """There is no such marker dictionary. The text suggests one and lists them all."""


def dictionary_by_name(name: str) -> cv2.aruco.Dictionary:
    """A dictionary of OpenCV by its name, in any case, with or without `DICT_`. Raises DictionaryError."""
    plain = name.strip().upper().removeprefix("DICT_")
    if plain not in DICTIONARIES:
        near = difflib.get_close_matches(plain, DICTIONARIES, 1, 0.5)
        suggestion = f"; did you mean {near[0]}?" if near else "."
        raise DictionaryError(f"no marker dictionary {name!r}{suggestion} There are: {', '.join(DICTIONARIES)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{plain}"))
