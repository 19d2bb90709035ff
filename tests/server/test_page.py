"""The page at `/`, in a real browser."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from playwright.async_api import Page, async_playwright

from camera.calibration import save_intrinsics
from server.app import Service
from server.config import parse
from tests.server.room import CAMERA, CONFIG, INTRINSICS, Ceiling, beside, client, fix, hello, imu, run, serving, until

CHROMIUM = Path("/usr/bin/chromium")
# Without the last four it looks for Google's hosts at every start.
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
FLAGS += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]

pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"{CHROMIUM} is not installed")


@contextlib.asynccontextmanager
async def tab(service: Service, host: str = "127.0.0.1") -> AsyncIterator[Page]:
    """The page in a browser of its own. It must have nothing to complain of."""
    complaints: list[str] = []
    async with async_playwright() as playwright:
        chromium = await playwright.chromium.launch(
            executable_path=CHROMIUM, args=[*FLAGS, "--host-resolver-rules=MAP steadfix.example 127.0.0.1"]
        )
        try:
            page = await chromium.new_page(viewport={"width": 1280, "height": 800})
            page.on("pageerror", lambda error: complaints.append(str(error)))
            await page.goto(f"http://{host}:{service.port}/")
            yield page
        finally:
            await chromium.close()
    assert complaints == []


@contextlib.asynccontextmanager
async def driving(service: Service, robot: str = "rover") -> AsyncIterator[None]:
    """The robot stands still and sends its IMU, as long as this lasts."""

    async def send() -> None:
        async with client(service, "/v1/robot") as connection:
            await hello(connection, robot)
            while True:
                await connection.send(imu(time.monotonic()))
                await asyncio.sleep(0.05)  # the pace of this robot

    async with beside(send()):
        yield


async def see(page: Page, expression: str) -> None:
    """Wait until a JavaScript expression is true. (Playwright's own way of waiting is against the page's policy.)"""
    while not await page.evaluate(expression):
        await asyncio.sleep(0.02)


ROW = "document.querySelector('#robots tr[data-name={}]')"
COLOURED = """(() => {
    const canvas = document.getElementById("map");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    // --robot-0 is #2362cf
    for (let i = 0; i < data.length; i += 4) count += data[i] < 60 && data[i + 1] < 120 && data[i + 2] > 190;
    return count;
})()"""
PICTURE = "document.getElementById('map').toDataURL()"


def test_robots_are_drawn_and_listed(tmp_path: Path) -> None:
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)

    async def main() -> None:
        config = parse(CONFIG + CAMERA, folder=tmp_path)
        async with serving(config, open_camera=Ceiling) as service, driving(service), tab(service) as page:
            console: list[str] = []
            page.on("console", lambda message: console.append(message.text))
            rover, cart = ROW.format("rover"), ROW.format("cart")
            await see(page, f"{rover}?.cells[1].innerText === 'full'")
            await see(page, f"{cart}?.cells[1].innerText === 'waiting'")
            await see(page, f"{rover}.cells[2].innerText !== '–'")
            name, _, speed, age, sigma = await page.evaluate(f"[...{rover}.cells].map((cell) => cell.innerText)")
            assert name == "rover"
            assert float(speed) < 1.0
            assert 0.0 <= float(age) < 10.0
            assert float(sigma) > 0.0
            await see(page, "document.querySelector('#cameras td + td')?.innerText === '3 markers'")
            assert "robot cart: no IMU has connected yet" in await page.inner_text("#trouble")
            await see(page, "!document.getElementById('advice').hidden")
            assert "camera ceiling: 4.0 px of blur at 1 m/s: halve the exposure" in await page.inner_text("#advice")
            # Its trail, ellipse and arrow are on the map, in its colour.
            coloured = await page.evaluate(COLOURED)
            assert coloured > 50
            await page.reload()
            await see(page, f"{rover}?.cells[1].innerText === 'full'")
            assert console == []

    run(main)


def test_a_robot_that_moves_is_drawn_elsewhere() -> None:
    async def main() -> None:
        async with serving() as service, tab(service) as page:
            row = ROW.format("rover")
            service.robots["rover"].feed_fix(fix(x=0.0), time.monotonic())
            await see(page, f"{row}?.cells[1].innerText === 'no IMU'")
            before = json.dumps(await page.evaluate(PICTURE))
            service.robots["rover"].feed_fix(fix(x=0.1), time.monotonic())
            await see(page, f"{PICTURE} !== {before}")
            # Then nobody knows any more where it is.
            await see(page, f"{row}.cells[1].innerText === 'lost'")
            assert await page.evaluate(f"{row}.cells[2].innerText") == "–"

    run(main)


def test_the_page_connects_again() -> None:
    async def main() -> None:
        async with contextlib.AsyncExitStack() as stack:
            async with serving() as service:
                page = await stack.enter_async_context(tab(service))
                await see(page, "document.getElementById('state-text').innerText === 'Something is missing'")
            await see(page, "!document.getElementById('lost').hidden")
            async with serving(CONFIG.replace("port = 0", f"port = {service.port}")) as again:
                again.robots["rover"].feed_fix(fix(), time.monotonic())
                await see(page, "document.getElementById('lost').hidden")
                await see(page, f"{ROW.format('rover')}?.cells[3].innerText > ''")
                assert len(again.hub.subscriptions) == 1

    run(main)


def test_a_hidden_tab_takes_nothing() -> None:
    async def main() -> None:
        async with serving() as service, tab(service) as page:
            for hidden, subscriptions in ((False, 1), (True, 0), (False, 1)):
                # A headless tab cannot be put behind another.
                await page.evaluate(
                    """(hidden) => {
                        Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
                        document.dispatchEvent(new Event("visibilitychange"));
                    }""",
                    hidden,
                )
                await until(lambda expected=subscriptions: len(service.hub.subscriptions) == expected)

    run(main)


def test_digits_do_not_jitter_and_both_schemes_are_there() -> None:
    async def main() -> None:
        async with serving() as service, tab(service) as page:
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            await see(page, f"{ROW.format('rover')}?.cells[3].innerText > ''")
            style = "getComputedStyle(document.querySelector('#robots td.number')).fontVariantNumeric"
            assert await page.evaluate(style) == "tabular-nums"
            brightness = []
            for scheme in ("light", "dark"):
                await page.emulate_media(color_scheme=scheme)
                colour = await page.evaluate("getComputedStyle(document.body).backgroundColor")
                brightness.append(sum(map(int, colour.removeprefix("rgb(").removesuffix(")").split(","))))
            assert brightness[0] > 600
            assert brightness[1] < 120

    run(main)


def test_from_another_machine_the_page_asks_for_the_token() -> None:
    async def main() -> None:
        async with (
            serving(CONFIG.replace("[server]", '[server]\ntoken = "look"')) as service,
            tab(service, "steadfix.example") as page,
        ):
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            text = "document.getElementById('locked-text').innerText"
            await see(page, f"{text} === 'From another machine, this service wants its token.'")
            await page.fill("#token", "guessed")
            await page.click("#locked button")
            await see(page, f"{text} === 'That is not the token.'")
            assert await page.inner_text("#state-text") == "Locked"
            await page.fill("#token", "look")
            await page.click("#locked button")
            await see(page, f"{ROW.format('rover')}?.cells[3].innerText > ''")
            assert not await page.is_visible("#locked")
            # It is kept.
            await page.reload()
            await see(page, f"{ROW.format('rover')}?.cells[3].innerText > ''")
        async with serving() as service, tab(service, "steadfix.example") as page:
            await see(page, f"{text}.startsWith('[server] has no token')")
            assert not await page.is_visible("#token")

    run(main)


@pytest.mark.parametrize("width", [360, 400, 600])
def test_all_columns_are_seen_on_a_phone(width: int) -> None:
    async def main() -> None:
        config = CONFIG.replace("rover", "a-robot-with-a-name-that-goes-on")
        async with serving(config) as service, tab(service) as page:
            await page.set_viewport_size({"width": width, "height": 800})
            name = "a-robot-with-a-name-that-goes-on"
            # The longest words and numbers that there are.
            await see(page, f"{ROW.format(json.dumps(name))}?.cells[1].innerText === 'waiting'")
            for cell, text in ((1, "degraded"), (2, "88.88"), (3, "999+"), (4, "9999+")):
                await page.evaluate(f"{ROW.format(json.dumps(name))}.cells[{cell}].innerText = '{text}'")
            right = (
                "Math.max(...[...document.querySelectorAll('#robots td')].map((c) => c.getBoundingClientRect().right))"
            )
            assert await page.evaluate(right) <= width
            assert await page.evaluate("document.documentElement.scrollWidth") <= width

    run(main)
