"""The page at `/phone`, in a real browser whose sensors are simulated by the browser itself, over real TLS."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import AsyncIterator

import numpy as np
import pytest
from playwright.async_api import CDPSession, Page, async_playwright

from fusion.measurements import Array, ImuBatch, PoseFix, WheelOdometry
from server.app import Service
from tests.server.room import CONFIG, fix, make_certificate, run, serving, until
from tests.server.test_page import CHROMIUM, FLAGS, see

pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"{CHROMIUM} is not installed")

# What the phone's sensors read, in its own axes: x right, y to the top, z out of the screen. m/s2, rad/s.
FORCE = (0.5, -0.25, 9.75)
RATE = (1.0, 2.0, 3.0)


class Recording:
    """Keeps what the robot sent."""

    def __init__(self) -> None:
        self.samples: list[Array] = []

    def imu(self, batch: ImuBatch) -> None:
        self.samples.append(batch.samples)

    def fix(self, fix: PoseFix) -> None: ...
    def wheels(self, odometry: WheelOdometry) -> None: ...
    def track(self, robot: str, track: Array) -> None: ...


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> str:
    certificate, key = make_certificate(tmp_path_factory.mktemp("tls"))
    lines = f'[server]\ncertificate = "{certificate}"\nkey = "{key}"'
    return CONFIG.replace("[server]", lines).replace('name = "rover"', 'name = "rover"\ntoken = "of the rover"')


@contextlib.asynccontextmanager
async def phone(script: str = "") -> AsyncIterator[tuple[Page, CDPSession]]:
    """A tab on a phone. `script` runs before the page's own."""
    complaints: list[str] = []
    async with async_playwright() as playwright:
        flags = [*FLAGS, "--host-resolver-rules=MAP steadfix.example 127.0.0.1"]
        chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        try:
            context = await chromium.new_context(
                ignore_https_errors=True, viewport={"width": 390, "height": 780}, has_touch=True, is_mobile=True
            )
            page = await context.new_page()
            page.on("pageerror", lambda error: complaints.append(str(error)))
            await page.add_init_script(script)
            yield page, await context.new_cdp_session(page)
        finally:
            await chromium.close()
    assert complaints == []


async def hold(cdp: CDPSession, force: tuple[float, ...], rate: tuple[float, ...], tilt: float = 0.0) -> None:
    """Let the sensors read this, and the orientation be `tilt` degrees about y."""
    readings = {"accelerometer": force, "linear-acceleration": (0.0, 0.0, 0.0), "gyroscope": rate}
    for kind, (x, y, z) in readings.items():
        await cdp.send("Emulation.setSensorOverrideEnabled", {"enabled": True, "type": kind})
        reading = {"xyz": {"x": x, "y": y, "z": z}}
        await cdp.send("Emulation.setSensorOverrideReadings", {"type": kind, "reading": reading})
    orientation = {"alpha": 0.0, "beta": 0.0, "gamma": tilt}
    await cdp.send("DeviceOrientation.setDeviceOrientationOverride", orientation)


async def begin(page: Page, service: Service, token: str = "of the rover") -> None:
    await page.goto(f"https://127.0.0.1:{service.port}/phone#robot=rover")
    await page.fill("#token", token)
    await page.tap("#start")


TROUBLE = "document.getElementById('trouble').innerText"
STATE = "document.getElementById('state-text').innerText"


@pytest.mark.parametrize(
    ("angle", "gyro", "accel"),
    [
        # Forward is the top of the screen: y of the phone, its right side when it is turned to the left, ...
        (0, (2.0, -1.0, 3.0), (-0.25, -0.5, 9.75)),
        (90, (1.0, 2.0, 3.0), (0.5, -0.25, 9.75)),
        (270, (-1.0, -2.0, 3.0), (-0.5, 0.25, 9.75)),
    ],
)
def test_a_phone_streams_its_motion_in_the_robots_axes(
    config: str, angle: int, gyro: tuple[float, ...], accel: tuple[float, ...]
) -> None:
    async def main() -> None:
        recording = Recording()
        async with serving(config, recording=recording) as service, phone() as (page, cdp):
            await hold(cdp, FORCE, RATE)
            kind = "portraitPrimary" if angle == 0 else "landscapePrimary" if angle == 90 else "landscapeSecondary"
            screen = {"width": 390, "height": 780, "deviceScaleFactor": 1, "mobile": True}
            orientation = {"type": kind, "angle": angle}
            await cdp.send("Emulation.setDeviceMetricsOverride", screen | {"screenOrientation": orientation})
            await begin(page, service)
            await until(lambda: len(recording.samples) >= 3)
            sample = recording.samples[-1][-1]
            # Chromium rounds what it tells a page, to 0.1 m/s2 and 0.1 deg/s.
            assert sample[1:4] == pytest.approx(gyro, abs=math.radians(0.1))
            assert sample[4:7] == pytest.approx(accel, abs=0.1)
            stamps = np.concatenate(recording.samples)[:, 0]
            assert (np.diff(stamps) > 0.0).all()
            assert (stamps <= time.monotonic()).all()
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            await see(page, f"{STATE} === 'Streaming as rover'")
            await see(page, "document.getElementById('mode').innerText === 'FULL'")
            assert float(await page.inner_text("#up")) == pytest.approx(9.75, abs=0.1)
            # The screen turns on, but the arrow still points to the robot's front.
            await cdp.send(
                "Emulation.setDeviceMetricsOverride",
                screen | {"screenOrientation": {"type": "portraitSecondary", "angle": 180}},
            )
            await see(page, f"document.getElementById('arrow').style.transform === 'rotate({angle - 180}deg)'")
            await page.tap("#stop")
            await until(lambda: service.robots["rover"].trouble == "its connection has ended")

    run(main)


IPHONE = "window.asked = 0; DeviceMotionEvent.requestPermission = async () => { window.asked += 1; return '%s'; };"


@pytest.mark.parametrize("tilt", [0.0, 60.0])
def test_an_iphone_asks_the_user_and_has_the_acceleration_the_other_way_round(config: str, tilt: float) -> None:
    async def main() -> None:
        recording = Recording()
        force = (9.75 * math.sin(math.radians(tilt)), 0.0, -9.75 * math.cos(math.radians(tilt)))
        async with serving(config, recording=recording) as service, phone(IPHONE % "granted") as (page, cdp):
            await hold(cdp, force, RATE, tilt)
            await begin(page, service)
            await until(lambda: len(recording.samples) >= 1)
            sample = recording.samples[0][0]
            assert sample[1:4] == pytest.approx((2.0, -1.0, 3.0), abs=math.radians(0.1))
            assert sample[4:7] == pytest.approx((0.0, force[0], -force[2]), abs=0.1)
            assert await page.evaluate("window.asked") == 1

    run(main)


def test_what_keeps_a_phone_from_streaming_is_said(config: str) -> None:
    async def main() -> None:
        async with serving(config) as service:
            async with phone(IPHONE % "denied") as (page, _):
                await begin(page, service)
                await see(page, f"{TROUBLE}.startsWith('The browser does not allow motion sensors')")
                assert await page.is_visible("#start")
            async with phone("delete window.DeviceMotionEvent;") as (page, _):
                await page.goto(f"https://127.0.0.1:{service.port}/phone")
                assert await page.inner_text("#trouble") == "This browser gives no motion data."
                assert await page.is_disabled("#start")
            async with phone() as (page, cdp):
                await hold(cdp, FORCE, RATE)
                await begin(page, service, token="of another")
                await see(page, f"{TROUBLE} === 'this is not the token of robot \"rover\"'")
                assert await page.is_visible("#start")
        # Of http:// a browser trusts this machine alone, by its own names.
        async with serving() as service, phone() as (page, _):
            await page.goto(f"http://steadfix.example:{service.port}/phone")
            assert "https:// only" in await page.inner_text("#trouble")
            assert await page.is_disabled("#start")

    run(main)


def test_the_page_connects_again(config: str) -> None:
    async def main() -> None:
        async with contextlib.AsyncExitStack() as stack:
            async with serving(config) as service:
                page, cdp = await stack.enter_async_context(phone())
                await hold(cdp, FORCE, RATE)
                await begin(page, service)
                await see(page, f"{STATE} === 'Streaming as rover'")
            await see(page, f"{STATE} === 'No connection'")
            async with serving(config.replace("port = 0", f"port = {service.port}")) as again:
                await until(lambda: again.robots["rover"].localiser.counts["imu_samples"] > 0)
                # What was said of it is kept for the next time.
                await page.reload()
                assert await page.input_value("#robot") == "rover"
                assert await page.input_value("#token") == "of the rover"

    run(main)
