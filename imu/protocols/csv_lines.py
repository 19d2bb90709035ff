"""Numbers separated by commas, one sample a line; by itself `t,gx,gy,gz,ax,ay,az` in s, rad/s and m/s2, body axes.

Other orders and units are named by a header line in the stream, or by `columns`:

    t[us],ax[g],ay[g],az[g],gx[deg/s],gy[deg/s],gz[deg/s],-

`t` may be absent. A unit stands in brackets, `[]` or `()`; without one a column is in SI units. Instead of a unit a
number may stand, by which the column is multiplied to give SI units: raw counts. `-` is a column that does not
matter. `name=3` is one that must read 3; other lines are skipped, as where several sensors share a line. Several
`t` columns are added up: `t[s],t[us]`. A header's own names count too (`Gyroscope X (deg/s)`, `acc_x_g`).
"""

from __future__ import annotations

import contextlib
import math
import re
from typing import NamedTuple

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.lines import MAX_LINE, LineParser

_G = 9.80665  # m/s2, standard gravity
_DEGREE = math.pi / 180.0
_NAMES = ("t", "gx", "gy", "gz", "ax", "ay", "az")
_UNITS = {
    "t": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "g": {
        "rad/s": 1.0, "rads": 1.0, "rps": 1.0, "mrad/s": 1e-3,
        "deg/s": _DEGREE, "dps": _DEGREE, "°/s": _DEGREE, "degs": _DEGREE, "mdps": 1e-3 * _DEGREE,
    },
    "a": {
        "m/s2": 1.0, "m/s^2": 1.0, "m/s²": 1.0, "m/s/s": 1.0, "ms2": 1.0, "mps2": 1.0,
        "g": _G, "mg": 1e-3 * _G,
    },
}  # fmt: skip
_UNIT_IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]$")
_UNIT_IN_NAME = re.compile(r"^(.*)_(s|ms|us|ns|rads|rps|degs|dps|mdps|ms2|mps2|g|mg)$")
_KINDS = (
    ("t", re.compile(r"(?:t|ts|time|timestamp|devicetime)()")),
    ("a", re.compile(r"(?:a|.*acc[a-z]*)([xyz])")),
    ("g", re.compile(r"(?:g|w|.*gyr[a-z]*|.*angularrate|.*angularvelocity|.*omega)([xyz])")),
)
_NOTATION = "needed: such as t[us],gx[deg/s],gy[deg/s],gz[deg/s],ax[g],ay[g],az[g], with - for other columns"


class ColumnsError(ValueError):
    """Columns that cannot be read as such. The text says what is wrong with them and what would be right."""


class Columns(NamedTuple):
    """Which of `width` columns is what.

    `times`: (column, s per unit); `axes`: (column, SI per unit) of gx ... az; `required`: (column, what it must read).
    """

    width: int
    times: tuple[tuple[int, float], ...]
    axes: tuple[tuple[int, float], ...]
    required: tuple[tuple[int, float], ...]


def parse_columns(text: str, *, header: bool = False) -> Columns:
    """Columns as the top of this file describes them; of a `header` the first of each name. Raises ColumnsError."""
    times: list[tuple[int, float]] = []
    axes: dict[str, tuple[int, float]] = {}
    required: list[tuple[int, float]] = []
    names = text.split(",")
    for i, name in enumerate(names):
        _, equals, value = name.partition("=")
        if equals and not header:
            try:
                required.append((i, float(value)))
            except ValueError:
                raise ColumnsError(f'column {i + 1}, "{name}": a number is needed after =') from None
            continue
        kind, axis, factor = _column(i, name, strict=not header)
        if kind == "t" and not (header and times):
            times.append((i, factor))
        elif kind and kind != "t":
            if kind + axis in axes and not header:
                raise ColumnsError(f"{kind + axis} is there twice; {_NOTATION}")
            axes.setdefault(kind + axis, (i, factor))
    if absent := [name for name in _NAMES[1:] if name not in axes]:
        raise ColumnsError(f"no column for {' '.join(absent)} in {text[:100]!r}; {_NOTATION}")
    return Columns(len(names), tuple(times), tuple(axes[name] for name in _NAMES[1:]), tuple(required))


def _column(i: int, text: str, *, strict: bool) -> tuple[str, str, float]:
    """Kind ("t", "g", "a", "" for none of them), axis and factor of one column."""
    name, unit = text.strip().strip('"').lower(), ""
    for pattern in (_UNIT_IN_BRACKETS, _UNIT_IN_NAME):
        if match := pattern.match(name):
            name, unit = match[1], match[2]
            break
    squeezed = re.sub(r"[^a-z]", "", name)
    kind, match = next(((kind, match) for kind, known in _KINDS if (match := known.fullmatch(squeezed))), ("", None))
    if match is None:
        if strict and name not in ("-", ""):
            raise ColumnsError(f'column {i + 1}, "{text}": unknown; known: {", ".join(_NAMES)}, - and name=number')
        return "", "", 1.0
    if not unit:
        return kind, match[1], 1.0
    factor = _UNITS[kind].get(unit)
    if factor is None:
        try:
            factor = float(unit)
        except ValueError:
            factor = math.nan
    if not math.isfinite(factor) or factor == 0.0:
        if kind == "t" and not strict:
            return "", "", 1.0  # a temperature
        known = ", ".join(list(_UNITS[kind])[:6])
        raise ColumnsError(f'column {i + 1}, "{text}": unknown unit; known: {known}, or a number to multiply by')
    return kind, match[1], factor


class CsvLines(LineParser):
    """See `LineParser`. Raises ColumnsError for `columns`.

    Where `columns` are given, header lines are skipped; else the last one counts: a device sends it again when it
    restarts. Everything up to the first end of line is skipped, unless it is a header: a line whose beginning was
    missed may still have the right number of numbers.
    """

    protocol = "csv"

    def __init__(self, columns: str = "") -> None:
        super().__init__(self._read)
        self._configured = bool(columns)
        self._columns = parse_columns(columns or ",".join(_NAMES))
        self._first_line: bytes | None = b""

    def feed(self, data: bytes) -> list[RawSample]:
        if self._first_line is not None:
            head, newline, data = data.partition(b"\n")
            self._first_line = (self._first_line + head)[:MAX_LINE]
            if newline:
                first, self._first_line = self._first_line, None
                self._begin(first)
        return super().feed(data)

    def _begin(self, line: bytes) -> None:
        """The first line, which may be the end of one: a header where it has a time or begins with a known name."""
        with contextlib.suppress(ColumnsError, ValueError):
            columns = parse_columns(line.decode().strip(), header=True)
            if not self._configured and (columns.times or any(i == 0 for i, _ in columns.axes)):
                self._columns = columns

    def _read(self, line: bytes) -> RawSample | None:
        fields = line.split(b",")
        try:
            values = [float(field) if field else None for field in fields]
        except ValueError:
            if len(fields) == 1 or any(_is_number(field) for field in fields):
                raise DroppedError("not a number", repr(line[:80])) from None
            self._header(line)
            return None
        width, times, axes, required = self._columns
        if len(values) != width:
            advice = "" if self._configured else f"; other columns have to be named, {_NOTATION}"
            raise DroppedError("wrong columns", f"{len(values)} instead of {width} in {line[:80]!r}{advice}")
        for i, value in required:
            if values[i] != value:
                return None
        t: float | None = None
        for i, factor in times:
            if (part := values[i]) is not None:
                t = (t or 0.0) + factor * part
        try:
            gx, gy, gz, ax, ay, az = [factor * values[i] for i, factor in axes]  # type: ignore[operator]
        except TypeError:
            raise DroppedError("not a number", repr(line[:80])) from None
        return raw_sample(t, (gx, gy, gz), (ax, ay, az))

    def _header(self, line: bytes) -> None:
        if not self._configured:
            try:
                self._columns = parse_columns(line.decode(errors="replace").strip(), header=True)
            except ColumnsError as error:
                raise DroppedError("unknown header", error) from None


def _is_number(field: bytes) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True
