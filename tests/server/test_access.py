"""Who is let in: tokens, this machine, Origins, TLS, and how much one connection may send."""

from __future__ import annotations

import hashlib
import json
import logging
import ssl
import subprocess
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus

from server.access import CertificateError, is_local, is_loopback, origin_allowed, tls, token_matches
from server.app import Service
from server.config import ConfigError, parse
from server.robot_client import AddressError, RefusedError, Robot
from tests.server.room import CONFIG, client, fix, heard, hello, imu, make_certificate, run, serving, until

TOKENS = CONFIG.replace("[server]", '[server]\ntoken = "look"').replace(
    'name = "rover"', 'name = "rover"\ntoken = "sha256:' + hashlib.sha256(b"drive").hexdigest() + '"'
)
# As seen from another machine: what stands before the service says so, or the name does.
ELSEWHERE = {"X-Forwarded-For": "192.0.2.7"}


@pytest.fixture(autouse=True)
def _no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.visitor.WRONG_TOKEN_PAUSE", 0.01)


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    return make_certificate(tmp_path_factory.mktemp("tls"))


def elsewhere(service: Service, path: str, **headers: str) -> connect:
    return connect(
        f"ws://127.0.0.1:{service.port}{path}",
        compression=None,
        proxy=None,
        additional_headers=ELSEWHERE | headers,
    )


async def reason(connection: Any, first: dict[str, Any] | None = None) -> str:
    """Why a connection is refused, after which it is closed."""
    if first is not None:
        await connection.send(json.dumps(first))
    error = await heard(connection, "error")
    with pytest.raises(ConnectionClosed):
        await connection.recv()
    return str(error["reason"])


# Tokens


@pytest.mark.parametrize(
    ("given", "configured", "right"),
    [
        ("drive", "drive", True),
        ("drive", "sha256:" + hashlib.sha256(b"drive").hexdigest(), True),
        ("drive", "sha256:" + hashlib.sha256(b"drive").hexdigest().upper(), True),
        ("dr\u00efve", "dr\u00efve", True),
        ("Drive", "drive", False),
        ("", "drive", False),
        # Who has read the configuration does not know the token.
        ("sha256:" + hashlib.sha256(b"drive").hexdigest(), "sha256:" + hashlib.sha256(b"drive").hexdigest(), False),
        (hashlib.sha256(b"drive").hexdigest(), "sha256:" + hashlib.sha256(b"drive").hexdigest(), False),
    ],
)
def test_tokens(given: str, configured: str, right: bool) -> None:
    assert token_matches(given, configured) is right


def test_a_robot_with_a_token_must_show_it() -> None:
    async def main() -> None:
        async with serving(TOKENS) as service:
            for shown, expected in (
                ({}, 'robot "rover" needs its token'),
                ({"token": "walk"}, 'this is not the token of robot "rover"'),
                ({"token": "look"}, 'this is not the token of robot "rover"'),
            ):
                async with client(service, "/v1/robot") as connection:
                    assert expected in await reason(connection, {"type": "hello", "robot": "rover", **shown})
            async with elsewhere(service, "/v1/robot") as connection:
                await connection.send(json.dumps({"type": "hello", "robot": "rover", "token": "drive"}))
                assert (await heard(connection))["type"] == "welcome"
            async with elsewhere(service, "/v1/robot", Authorization="Bearer drive") as connection:
                await until(lambda: not service._links)
                assert (await hello(connection))["type"] == "welcome"
            assert service.refused == 3

    run(main)


def test_a_robot_without_a_token_is_taken_from_this_machine_only() -> None:
    async def main() -> None:
        async with serving(TOKENS) as service:
            async with elsewhere(service, "/v1/robot") as connection:
                said = await reason(connection, {"type": "hello", "robot": "cart", "token": "guessed"})
                assert said.startswith('robot "cart" has no token in the configuration')
            async with client(service, "/v1/robot") as connection:
                assert (await hello(connection, "cart"))["type"] == "welcome"
            async with elsewhere(service, "/v1/robot") as connection:
                # Which names there are is not for everybody.
                assert 'robot "tank" needs its token' in await reason(connection, {"type": "hello", "robot": "tank"})
            async with elsewhere(service, "/v1/robot") as connection:
                said = await reason(connection, {"type": "hello", "robot": "tank", "token": "guessed"})
                assert said == 'this is not the token of robot "tank"'

    run(main)


def test_those_who_look_on_from_elsewhere_need_the_services_token() -> None:
    async def main() -> None:
        async with serving(TOKENS) as service:
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            async with client(service, "/v1/poses") as connection:
                assert (await heard(connection, "pose"))["robot"] == "rover"
            async with elsewhere(service, "/v1/poses", Authorization="Bearer look") as connection:
                assert (await heard(connection, "pose"))["robot"] == "rover"
            async with elsewhere(service, "/v1/poses") as connection:
                await connection.send(json.dumps({"type": "hello", "token": "look"}))
                assert (await heard(connection, "pose"))["robot"] == "rover"
            async with elsewhere(service, "/v1/poses") as connection:
                assert "not the token" in await reason(connection, {"type": "hello", "token": "drive"})
            async with elsewhere(service, "/v1/poses", Authorization="Bearer drive") as connection:
                assert "not the token" in await reason(connection)
            with pytest.raises(InvalidStatus, match="401"):
                await elsewhere(service, "/")
            async with elsewhere(service, "/", Authorization="Bearer look"):
                pass

    run(main)


def test_without_a_token_only_this_machine_looks_on_but_the_original_stream_is_open_as_it_was() -> None:
    async def main() -> None:
        async with serving() as service:
            async with elsewhere(service, "/v1/poses") as connection:
                assert "[server] has no token in the configuration" in await reason(connection)
            async with elsewhere(service, "/"):
                await until(lambda: len(service.hub.subscriptions) == 1)

    run(main)


@pytest.mark.parametrize(("config", "token", "status"), [(TOKENS, "look", 200), (TOKENS, "x", 401), (CONFIG, "", 403)])
def test_health_from_elsewhere(config: str, token: str, status: int) -> None:
    async def main() -> None:
        async with serving(config) as service:
            with pytest.raises(InvalidStatus) as refused:
                # No WebSocket: the way to a plain answer with a header of our own.
                await elsewhere(service, "/healthz", Authorization=f"Bearer {token}", Upgrade="nothing")
            assert refused.value.response.status_code == status
            body = refused.value.response.body
            assert (b'"robots"' in body) is (status == 200)

    run(main)


def test_what_of_a_token_is_no_hash() -> None:
    with pytest.raises(ConfigError, match=r'robot "rover", token: found "sha256:12"; needed: .*64 hexadecimal'):
        parse(TOKENS.replace(hashlib.sha256(b"drive").hexdigest(), "12"))


def test_json_in_a_binary_message_is_answered_in_json() -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            await connection.send(b'{"type":"hello","robot":"rover"}')
            assert "JSON goes into text messages" in (await heard(connection, "error"))["reason"]
            assert (await hello(connection))["type"] == "welcome"

    run(main)


def test_many_tokens_are_not_tried_in_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.visitor.WRONG_TOKEN_PAUSE", 0.3)

    async def main() -> None:
        async with serving(TOKENS) as service, client(service, "/v1/robot") as connection:
            asked = time.monotonic()
            await reason(connection, {"type": "hello", "robot": "rover", "token": "walk"})
            assert time.monotonic() - asked >= 0.3

    run(main)


# This machine


@pytest.mark.parametrize(
    ("peer", "headers", "local"),
    [
        ("127.0.0.1", {"host": "localhost:5678"}, True),
        ("127.0.0.1", {"host": "127.0.0.1:5678"}, True),
        ("::1", {"host": "[::1]:5678"}, True),
        ("::ffff:127.0.0.1", {"host": "localhost"}, True),
        ("192.0.2.7", {"host": "localhost:5678"}, False),
        ("::ffff:192.0.2.7", {"host": "localhost"}, False),
        ("fe80::1%eth0", {"host": "localhost"}, False),
        ("127.0.0.1", {"host": "steadfix.example:5678"}, False),
        ("127.0.0.1", {"host": "localhost.example"}, False),
        ("127.0.0.1", {"host": "[::1"}, False),
        ("127.0.0.1", {}, False),
        ("127.0.0.1", {"host": "localhost", "x-forwarded-for": "192.0.2.7"}, False),
        ("127.0.0.1", {"host": "localhost", "forwarded": "for=192.0.2.7"}, False),
        ("", {"host": "localhost"}, False),
    ],
)
def test_this_machine(peer: str, headers: dict[str, str], local: bool) -> None:
    assert is_local(peer, headers) is local


@pytest.mark.parametrize("host", ["0.0.0.0", "", "::", "192.0.2.7"])
def test_what_is_not_this_machine_alone(host: str) -> None:
    assert not is_loopback(host)


def test_who_is_let_in_is_said_at_the_start(caplog: pytest.LogCaptureFixture) -> None:
    async def main() -> None:
        with caplog.at_level(logging.WARNING):
            async with serving(TOKENS.replace("port = 0", 'port = 0\nhost = "0.0.0.0"')):
                pass
        assert "without a token, taken from this machine only: cart" in caplog.text
        assert "without a certificate under [server], tokens can be read by others" in caplog.text

    run(main)


# Pages in browsers


@pytest.mark.parametrize(
    ("origin", "local", "allowed"),
    [
        (None, False, True),
        ("http://robots.example:5678", False, True),
        ("https://robots.example:5678", False, True),
        ("https://panel.example", False, True),
        ("http://panel.example", False, False),
        ("http://evil.example", True, False),
        ("http://robots.example:5679", False, False),
        ("http://localhost:3000", True, True),
        ("http://localhost:3000", False, False),
        ("file://", False, True),
        ("null", True, False),
        ("http://[::1", True, False),
        ("", True, False),
    ],
)
def test_origins(origin: str | None, local: bool, allowed: bool) -> None:
    headers = {"host": "robots.example:5678"} | ({} if origin is None else {"origin": origin})
    assert origin_allowed(headers, local, ["https://panel.example"]) is allowed


def test_a_page_of_another_address_is_kept_out() -> None:
    async def main() -> None:
        config = CONFIG.replace("[server]", '[server]\norigins = ["https://panel.example"]')
        async with serving(config) as service:
            for path in ("/v1/poses", "/v1/robot"):
                url = f"ws://127.0.0.1:{service.port}{path}"
                with pytest.raises(InvalidStatus) as refused:
                    await connect(url, origin="http://evil.example", proxy=None)
                assert refused.value.response.status_code == 403
                assert b"needed: `origins` under [server]" in refused.value.response.body
                async with connect(url, origin="https://panel.example", proxy=None):
                    pass

    run(main)


# How much


def test_a_flood_is_made_to_wait_and_the_others_are_not(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("server.visitor.BYTES_PER_SECOND", 50_000)
    monkeypatch.setattr("server.visitor.SAVED_UP", 0.5)

    async def main() -> None:
        async with (
            serving() as service,
            client(service, "/v1/robot") as flooding,
            client(service, "/v1/robot") as other,
        ):
            await hello(flooding)
            await hello(other, "cart")
            began = time.monotonic()
            for _ in range(100):
                await flooding.send(imu(5.0, n=1))
            await other.send(imu(5.0))
            counts = {name: service.robots[name].localiser for name in ("rover", "cart")}
            await until(lambda: counts["cart"].counts["imu_samples"] == 10)
            assert counts["rover"].counts["imu_samples"] < 100
            await until(lambda: counts["rover"].counts["imu_samples"] == 100)
            # 100 messages of 500 bytes and what is in them, less what was saved up.
            assert time.monotonic() - began > 0.5
            assert "more than 50 kB a second come" in caplog.text
            assert "more than 50 kB a second come" in (await heard(flooding, "notice"))["text"]

    run(main)


def test_no_more_connections_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.door.MAX_CONNECTIONS", 2)

    async def main() -> None:
        async with serving() as service, client(service, "/v1/poses"):
            async with client(service, "/v1/poses"):
                await until(lambda: len(service.hub.subscriptions) == 2)
                with pytest.raises(InvalidStatus, match="503"):
                    await client(service, "/v1/poses")
            await until(lambda: len(service.hub.subscriptions) == 1)
            async with client(service, "/v1/poses"):
                pass

    run(main)


# TLS


def secured(certificate: tuple[str, str]) -> str:
    lines = f'certificate = "{certificate[0]}"\nkey = "{certificate[1]}"'
    return TOKENS.replace("[server]", f"[server]\n{lines}")


@pytest.mark.parametrize("format", ["json", "msgpack"])
def test_a_robot_over_tls(certificate: tuple[str, str], format: Any) -> None:
    async def main() -> None:
        async with serving(secured(certificate)) as service:
            url = f"wss://127.0.0.1:{service.port}"
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            async with Robot(url, "rover", token="drive", format=format, certificate=certificate[0]) as robot:
                await robot.send([(robot.clock(), 0.0, 0.0, 0.0, 0.0, 0.0, 9.80665)])
                async for pose in robot.poses():
                    if isinstance(pose.t_robot, float):
                        break
                assert pose.position == pytest.approx([1.0, 2.0, 0.0], abs=0.05)
                assert service._links["rover"].visitor.dialect.binary is (format == "msgpack")
            with pytest.raises(ssl.SSLCertVerificationError):
                async with Robot(url, "rover", token="drive"):
                    pass

    run(main)


def test_what_speaks_no_tls_is_survived(certificate: tuple[str, str], caplog: pytest.LogCaptureFixture) -> None:
    async def main() -> None:
        async with serving(secured(certificate)) as service:
            with pytest.raises(InvalidMessage):
                await connect(f"ws://127.0.0.1:{service.port}/v1/poses", proxy=None, open_timeout=5)
            context = ssl.create_default_context(cafile=certificate[0])
            async with connect(f"wss://127.0.0.1:{service.port}/v1/poses", ssl=context, proxy=None):
                await until(lambda: len(service.hub.subscriptions) == 1)
        assert "Traceback" not in caplog.text

    run(main)


def test_certificates_that_cannot_be_used(certificate: tuple[str, str], tmp_path: Path) -> None:
    path, key = certificate
    other = make_certificate(tmp_path)
    locked = tmp_path / "locked.pem"
    subprocess.run(
        ["openssl", "pkey", "-in", key, "-aes256", "-passout", "pass:secret", "-out", str(locked)],
        check=True,
        timeout=60,
    )
    empty = tmp_path / "empty.pem"
    empty.touch()
    for chain, private, expected in (
        (path, str(tmp_path / "none.pem"), r"key: .*none\.pem: no such file"),
        (str(tmp_path), key, "certificate: .*: is a directory"),
        (key, key, "is no certificate: there is no line with BEGIN CERTIFICATE"),
        (path, path, "is no key: there is no line with PRIVATE KEY"),
        (str(empty), key, r"empty\.pem is no certificate"),
        (path, other[1], "key values mismatch"),
        (path, str(locked), r"locked\.pem has a password"),
    ):
        with pytest.raises(CertificateError, match=expected):
            tls(chain, private)
    assert tls("", "") is None
    with pytest.raises(ConfigError, match='certificate: the key "key" is missing'):
        parse('[server]\ncertificate = "a.pem"')
    assert parse('[server]\ncertificate = "a.pem"\nkey = "b.pem"', folder=tmp_path).server.key == str(
        tmp_path / "b.pem"
    )


# The robot's client


def test_a_wrong_token_is_told_at_the_door() -> None:
    async def main() -> None:
        async with serving(TOKENS) as service:
            with pytest.raises(RefusedError, match='this is not the token of robot "rover"'):
                async with Robot(f"ws://127.0.0.1:{service.port}", "rover", token="walk"):
                    pass

    run(main)


def test_a_robot_that_was_switched_off_and_on_waits_until_its_name_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.app.SILENCE", 0.5)

    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as dead:
            await hello(dead)
            async with Robot(f"ws://127.0.0.1:{service.port}", "rover") as robot:
                assert robot.connected
            assert service.refused > 0

    run(main)


def test_two_robots_of_one_name_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.robot_client.TAKEN_FOR", 0.1)

    async def main() -> None:
        async with serving() as service, Robot(f"ws://127.0.0.1:{service.port}", "rover"):
            with pytest.raises(RefusedError, match='robot "rover" is already connected'):
                async with Robot(f"ws://127.0.0.1:{service.port}", "rover"):
                    pass

    run(main)


@pytest.mark.parametrize(
    "url", ["", "192.168.1.10:5678", "http://127.0.0.1:5678", "ws://", "ws://[::1", "ws://h/v1/robot"]
)
def test_an_address_that_is_none(url: str) -> None:
    with pytest.raises(AddressError, match=r"no address of a service; needed: one like ws://"):
        Robot(url, "rover")


def test_poses_as_msgpack() -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/poses?format=msgpack&robots=rover") as connection:
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            data = await connection.recv()
            assert isinstance(data, bytes)
            assert msgspec.msgpack.decode(data)["position"] == pytest.approx([1.0, 2.0, 0.0], abs=0.01)

    run(main)
