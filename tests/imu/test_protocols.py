from __future__ import annotations

import json
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imu.protocols import RawSample
from imu.protocols.csv_lines import CsvLines
from imu.protocols.json_lines import JsonLines
from imu.protocols.lines import MAX_LINE, LineParser

SAMPLES = [RawSample(10.0 + 0.005 * i, 0.01 * i, -0.02, 1e-3, 0.1, -0.2 * i, 9.81) for i in range(7)]


def json_line(sample: RawSample) -> bytes:
    return json.dumps({"t": sample.device_time, "gyro": sample[1:4], "accel": sample[4:7]}).encode() + b"\n"


def csv_line(sample: RawSample) -> bytes:
    return ",".join(map(repr, sample)).encode() + b"\r\n"


LINES = {JsonLines: json_line, CsvLines: csv_line}
both = pytest.mark.parametrize("protocol", [JsonLines, CsvLines])


def stream(protocol: type[LineParser], samples: list[RawSample] = SAMPLES) -> bytes:
    """As it comes after the first end of line."""
    return b"\n" + b"".join(map(LINES[protocol], samples))


@both
@given(cuts=st.lists(st.integers(0, 700)))
def test_the_same_samples_however_the_bytes_are_split(protocol: type[JsonLines | CsvLines], cuts: list[int]) -> None:
    data = stream(protocol)
    parser = protocol()
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    samples = [sample for a, b in pairwise(edges) for sample in parser.feed(data[a:b])]
    assert samples == SAMPLES
    assert parser.dropped == 0


@both
@given(noise=st.lists(st.binary(max_size=80), min_size=3, max_size=3), split=st.integers(1, 50))
def test_noise_costs_at_most_the_lines_it_touches(
    protocol: type[JsonLines | CsvLines], noise: list[bytes], split: int
) -> None:
    """Two samples, noise, two samples, noise, ...: of each two only the first may be lost."""
    line = LINES[protocol]
    data = b"\n" + b"".join(
        line(SAMPLES[2 * i]) + line(SAMPLES[2 * i + 1]) + rubbish for i, rubbish in enumerate(noise)
    )
    data += line(SAMPLES[6]) + b"\n"
    parser = protocol()
    samples = [sample for i in range(0, len(data), split) for sample in parser.feed(data[i : i + split])]
    assert {SAMPLES[1], SAMPLES[3], SAMPLES[5]} <= set(samples)


@both
def test_memory_is_bounded(protocol: type[JsonLines | CsvLines]) -> None:
    parser = protocol()
    parser.feed(b"\n")
    for _ in range(1000):
        assert parser.feed(b"x" * 1000) == []
        assert len(parser._partial) <= MAX_LINE
    assert parser.dropped == 1
    assert parser.reasons == {"too long": 1}
    assert parser.feed(stream(protocol)) == SAMPLES


JSON_FAULTS = {
    b'{"gyro": [0, 0, 0], "accel": [0, 0, NaN]}': "not JSON",
    b'{"gyro": [0, 0, 0], "accel": [0, 0, 1e999]}': "wrong fields",
    b'{"gyro": [0, 0, 0], "accel": [0, 0]}': "wrong fields",
    b'{"gyro": [0, 0, 0, 0], "accel": [0, 0, 9.8]}': "wrong fields",
    b'{"gyro": [0, 0, "1"], "accel": [0, 0, 9.8]}': "wrong fields",
    b'{"t": 1}': "wrong fields",
    b"[1, 2, 3]": "wrong fields",
    b'{"gyro": [0, 0, 0], "accel"': "not JSON",
    b"\xff\xfe": "not JSON",
    b'{"x": ' + b"[" * 4000: "not JSON",
    b'{"gyro": [0, 0, 1e9], "accel": [0, 0, 9.8]}': "out of range",
    b'{"t": 1e200, "gyro": [0, 0, 0], "accel": [0, 0, 9.8]}': "out of range",
}
CSV_FAULTS = {
    b"1,0,0,0,0,0,nan": "not finite",
    b"1,0,0,0,0,0,inf": "not finite",
    b"nan,0,0,0,0,0,9.8": "not finite",
    b"1,0,0,0,0,0": "wrong columns",
    b"1,0,0,0,0,0,9.8,1": "wrong columns",
    b"1,0,0,0,0,,9.8": "not a number",
    b"1,0,0,0,\xff,0,9.8": "not a number",
    b"1;0;0;0;0;0;9.8": "not a number",
    b"1,0,0,201,0,0,9.8": "out of range",
}


@pytest.mark.parametrize(
    ("protocol", "line", "reason"),
    [(JsonLines, *fault) for fault in JSON_FAULTS.items()] + [(CsvLines, *fault) for fault in CSV_FAULTS.items()],
)
def test_what_is_dropped_and_why(protocol: type[JsonLines | CsvLines], line: bytes, reason: str) -> None:
    parser = protocol()
    assert parser.feed(stream(protocol) + line + stream(protocol)) == SAMPLES * 2
    assert parser.dropped == 1
    assert parser.reasons == {reason: 1}
    assert parser.last_error.startswith(f"{reason}: ")


def test_json_without_a_time_and_with_other_keys() -> None:
    assert JsonLines().feed(b'{"gyro": [0, 0, 1], "accel": [0, 0, 9.81], "temperature": 20}\n') == [
        RawSample(None, 0, 0, 1, 0, 0, 9.81)
    ]


def test_csv_begins_with_the_first_whole_line_and_skips_headers() -> None:
    """What is left of `12.5` still is a number: only the end of the line tells that it was one."""
    parser = CsvLines()
    header = b"t, gx, gy, gz, ax, ay, az\n"
    assert parser.feed(b".5,0,0,0,0,0,9.81\n" + header + csv_line(SAMPLES[0]) + header) == SAMPLES[:1]
    assert parser.dropped == 0
