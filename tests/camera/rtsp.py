"""A network camera on a thread: RTSP (RFC 2326) with JPEG in RTP (RFC 2435) over the same connection."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable

import cv2
import numpy as np

PAYLOAD = 1400
CLOCK_HZ = 90_000


class NetworkCamera:
    """Serves one viewer after the other. `picture(k)`: the k-th frame (height, width, 3), of sides that 16 divides.

    `stamp(k)`: when it was taken, s; it is sent as soon as `due(k)` returns.
    """

    def __init__(
        self, picture: Callable[[int], np.ndarray], stamp: Callable[[int], float], due: Callable[[int], None]
    ) -> None:
        self._picture, self._stamp, self._due = picture, stamp, due
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"rtsp://127.0.0.1:{self._socket.getsockname()[1]}/stream"
        self._viewer: socket.socket | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def hang_up(self) -> None:
        """End the viewer's connection."""
        if self._viewer is not None:
            with contextlib.suppress(OSError):
                self._viewer.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._closed.set()
        self.hang_up()
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join()

    def _serve(self) -> None:
        while not self._closed.is_set():
            try:
                self._viewer, _ = self._socket.accept()
            except OSError:
                return
            with self._viewer, contextlib.suppress(OSError):
                if self._converse(self._viewer):
                    self._play(self._viewer)

    def _converse(self, viewer: socket.socket) -> bool:
        """Answer until PLAY."""
        with viewer.makefile("rb") as requests:
            while line := requests.readline():
                method = line.split()[0].decode()
                headers = {}
                while (header := requests.readline().strip()) != b"":
                    name, _, value = header.decode().partition(":")
                    headers[name.lower()] = value.strip()
                answer = f"RTSP/1.0 200 OK\r\nCSeq: {headers['cseq']}\r\n"
                body = ""
                if method == "OPTIONS":
                    answer += "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
                elif method == "DESCRIBE":
                    body = (
                        "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nt=0 0\r\nm=video 0 RTP/AVP 26\r\na=control:0\r\n"
                    )
                    answer += f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
                elif method == "SETUP":
                    answer += "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n"
                viewer.sendall((answer + "\r\n" + body).encode())
                if method == "PLAY":
                    return True
        return False

    def _play(self, viewer: socket.socket) -> None:
        sequence = k = 0
        while not self._closed.is_set():
            self._due(k)
            for packet in _packets(self._picture(k), round(self._stamp(k) * CLOCK_HZ), sequence):
                viewer.sendall(b"$\0" + struct.pack("!H", len(packet)) + packet)
                sequence += 1
            k += 1


def _packets(picture: np.ndarray, timestamp: int, sequence: int) -> list[bytes]:
    height, width = picture.shape[:2]
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
    tables, scan = _parts(encoded.tobytes())
    packets = []
    for offset in range(0, len(scan), PAYLOAD):
        part = scan[offset : offset + PAYLOAD]
        last = offset + PAYLOAD >= len(scan)
        rtp = struct.pack("!BBHII", 0x80, 26 | last << 7, (sequence + len(packets)) & 0xFFFF, timestamp & 0xFFFFFFFF, 7)
        # Type 1 is 4:2:0; Q 255 says that the first packet brings the quantisation tables.
        jpeg = struct.pack("!IBBBB", offset, 1, 255, width // 8, height // 8)
        if offset == 0:
            jpeg += struct.pack("!BBH", 0, 0, len(tables)) + tables
        packets.append(rtp + jpeg + part)
    return packets


def _parts(jpeg: bytes) -> tuple[bytes, bytes]:
    """Quantisation tables and entropy-coded data of a baseline JPEG."""
    tables, at = b"", 2
    while True:
        marker, length = struct.unpack("!HH", jpeg[at : at + 4])
        body = jpeg[at + 4 : at + 2 + length]
        at += 2 + length
        if marker == 0xFFDB:
            while body:
                tables, body = tables + body[1:65], body[65:]
        elif marker == 0xFFDA:
            return tables, jpeg[at:-2]
