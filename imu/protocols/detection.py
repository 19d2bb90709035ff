"""Which protocol, and at which speed: by trying all parsers on what comes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

from imu.protocols import DroppedError, Parser, RawSample
from imu.protocols.bno08x_rvc import Bno08xRvc
from imu.protocols.csv_lines import CsvLines
from imu.protocols.json_lines import JsonLines
from imu.protocols.mavlink import Mavlink, MavlinkMissingError
from imu.protocols.steadfix_frames import SteadfixFrames
from imu.protocols.vectornav_ascii import VectorNavAscii
from imu.protocols.vectornav_binary import VectorNavBinary
from imu.protocols.witmotion import WitMotion

ProtocolName = Literal[
    "auto", "json", "csv", "steadfix", "witmotion", "bno08x-rvc", "vectornav", "vectornav-binary", "mavlink"
]
# bits/s, in the order in which they are tried: those that devices come with first.
BAUD_RATES = (115200, 9600, 57600, 921600, 460800, 230400, 38400, 19200, 1_000_000, 2_000_000)
# Samples by which a protocol is recognised.
ENOUGH = 4
# Bytes without them after which the next speed is tried: of what is neither text nor has a single good frame, which a
# wrong speed looks like, and of anything.
NOISE, PUZZLED = 512, 4096


def open_parser(protocol: ProtocolName, columns: str = "", baud: int = 0) -> Parser:
    """A parser for `protocol`; `columns` are for CSV, `baud` is where a `Detector` begins.

    Raises ColumnsError and MavlinkMissingError.
    """
    if protocol == "auto":
        return Detector(columns, baud)
    return _makers(columns)[protocol]()


def _makers(columns: str) -> dict[str, Callable[[], Parser]]:
    return {
        "json": JsonLines,
        "csv": lambda: CsvLines(columns),
        "steadfix": SteadfixFrames,
        "witmotion": WitMotion,
        "bno08x-rvc": Bno08xRvc,
        "vectornav": VectorNavAscii,
        "vectornav-binary": VectorNavBinary,
        "mavlink": Mavlink,
    }


class Detector(Parser):
    """All parsers at once, until one has given ENOUGH samples; from then on that one. Raises ColumnsError.

    `baud`: the speed at which to listen, which changes while nothing is recognised: set the port to it after each
    `feed`; 0 where there is no port. Silence changes nothing, since nothing is to be learnt from it.
    """

    def __init__(self, columns: str = "", baud: int = 0) -> None:
        super().__init__()
        self.baud = baud
        self._bauds = [baud, *(other for other in BAUD_RATES if other != baud)]
        self._makers = _makers(columns)
        self._chosen: Parser | None = None
        self._begin()

    def _begin(self) -> None:
        self._heard = b""
        self._candidates: list[tuple[Parser, list[RawSample]]] = []
        self._absent = ""
        for make in self._makers.values():
            try:
                self._candidates.append((make(), []))
            except MavlinkMissingError as error:
                self._absent = str(error)

    def feed(self, data: bytes) -> list[RawSample]:
        samples = self._try(data) if self._chosen is None else self._chosen.feed(data)
        self._report()
        return samples

    def settle(self) -> list[RawSample]:
        """No more will come: the samples of the parser that has understood most, too few to be sure of it till now."""
        if self._chosen is None:
            parser, samples = self._best()
            if parser.frames:
                self._choose(parser)
                return samples
            if self._heard.strip():
                self._give_up()
        return []

    def _best(self) -> tuple[Parser, list[RawSample]]:
        return max(self._candidates, key=lambda candidate: (len(candidate[1]), candidate[0].frames))

    def _choose(self, parser: Parser) -> None:
        self._chosen = parser
        self.protocol, self.note, self.reasons = parser.protocol, parser.note, parser.reasons
        self._report()

    def _report(self) -> None:
        if self._chosen is not None:
            self.frames, self.last_error = self._chosen.frames, self._chosen.last_error
            self.dropped_bytes, self.missing = self._chosen.dropped_bytes, self._chosen.missing

    def _try(self, data: bytes) -> list[RawSample]:
        for parser, samples in self._candidates:
            samples += parser.feed(data)
            if len(samples) >= ENOUGH:
                self._choose(parser)
                return samples
        self._heard += data[:PUZZLED]
        self.dropped_bytes += len(data)
        best, _ = self._best()
        if len(self._heard) >= PUZZLED and best.frames >= ENOUGH:
            # A known protocol, with other messages than those wanted.
            self._choose(best)
        elif len(self._heard) >= (PUZZLED if best.frames or _is_text(self._heard) else NOISE):
            self._give_up()
            if self.baud:
                self.baud = self._bauds[(self._bauds.index(self.baud) + 1) % len(self._bauds)]
            self._begin()
        return []

    def _give_up(self) -> None:
        found = describe(self._heard)
        if self.baud:
            found += f" (at {self.baud} baud)"
        if self._absent and not _is_text(self._heard):
            found += f"; {self._absent}"
        self._drop(DroppedError("not recognised", found))


def _is_text(data: bytes) -> bool:
    return sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in data) > 0.95 * len(data)


def describe(data: bytes) -> str:
    """In words, what bytes look like that no parser understands."""
    if _is_text(data) and b"\n" in data:
        lines = [line.strip() for line in data.split(b"\n")[1:-1] if line.strip()]
        line = lines[len(lines) // 2] if lines else data.strip()
        what = f"text of no known form, such as {line[:80].decode(errors='replace')!r}"
        if line.count(b",") >= 5:
            what += '; its columns have to be named, such as "t[us],gx[deg/s],gy[deg/s],gz[deg/s],ax[g],ay[g],az[g]"'
        if line.startswith(b"{"):
            what += '; as JSON it needs "gyro": [x, y, z] and "accel": [x, y, z], of finite numbers'
        return what
    if data.count(data[:1]) == len(data):
        return f"nothing but the byte {data[0]:#04x}: a wrong baud rate, or a line that hangs"
    return f"neither text nor known frames, but {data[:12].hex(' ')} ...: a wrong baud rate, or an unknown protocol"


assert set(get_args(ProtocolName)) == {"auto", *_makers("")}
