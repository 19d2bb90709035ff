"""`steadfix allan`: hours of an IMU at rest -> its noise, as the filter wants it."""

from __future__ import annotations

import argparse
import json
import math
import sys
import textwrap
from pathlib import Path

import numpy as np

from imu.allan import SENSORS, Allan, Noise, analyse, fitted
from server.imu_readings import add_source, file_readings

# s: a shorter rest tells little of how a bias walks.
LONG = 3600.0
MOUNTED = (
    "On a robot that drives, the noise is 10 to 20 times that of one at rest: motors, wheels and the floor shake it. "
    "With --mounted 10 it is multiplied; then let `steadfix replay` judge it by a recorded drive."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    add_source(parser, port=False)
    parser.add_argument("--plot", type=_picture, metavar="FILE", help="draw the deviations, as .png or .svg")
    parser.add_argument(
        "--mounted", type=_factor, default=1.0, metavar="K", help="multiply the white noise by K, as for a moving robot"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of TOML")


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in (".png", ".svg"):
        raise argparse.ArgumentTypeError(f"{text}: a name that ends in .png or .svg is needed")
    return path


def _factor(text: str) -> float:
    factor = float(text)
    if not 1.0 <= factor <= 1000.0:
        raise argparse.ArgumentTypeError(f"{text}: a factor from 1 to 1000 is needed")
    return factor


def run(args: argparse.Namespace) -> int:
    """Runs the command. Raises CalibrationError for a file without a long rest."""
    found = analyse(file_readings(args))
    if args.plot is not None:
        draw(found, args.plot)
    print(json.dumps(_plain(found)) if args.json else _text(found, args.mounted))
    if found.seconds < LONG:
        print(
            f"steadfix: {found.seconds:.0f} s of rest show the white noise, but hardly how the biases walk: hours do",
            file=sys.stderr,
        )
    print(f"steadfix: {MOUNTED}", file=sys.stderr)
    return 0


def _plain(found: Allan) -> dict[str, object]:
    """None for what does not show."""

    def value(figure: float) -> float | None:
        return figure if math.isfinite(figure) else None

    def axis(noise: Noise) -> dict[str, object]:
        return {
            "tau": noise.tau.tolist(),
            "deviation": noise.deviation.tolist(),
            "density": value(noise.density),
            "flicker": value(noise.flicker),
            "walk": value(noise.walk),
        }

    return {
        "start": found.start,
        "seconds": found.seconds,
        "rate_hz": found.rate_hz,
        "gyro": [axis(noise) for noise in found.gyro],
        "accel": [axis(noise) for noise in found.accel],
    }


def _text(found: Allan, mounted: float) -> str:
    """A table in comments, and the section for the configuration: of each sensor the worst axis."""
    lasting = f"{found.seconds / 3600.0:.2f} h" if found.seconds >= LONG else f"{found.seconds:.0f} s"
    lines = [f"at rest for {lasting} from {found.start:.1f} s on, {found.rate_hz:.2f} Hz; x y z, - is not seen"]
    keys = []
    for name, _, unit in SENSORS:
        axes: list[Noise] = getattr(found, name)
        for kind, per in (("density", "/sqrt(Hz)"), ("flicker", ""), ("walk", "/s/sqrt(Hz)")):
            figures = [getattr(noise, kind) for noise in axes]
            shown = " ".join(f"{figure:.2e}" if math.isfinite(figure) else "-" for figure in figures)
            lines.append(f"{name:<7}{kind:<9}{shown:<28}{unit}{per}")
            if kind == "flicker":
                continue
            key = f"{name}_noise" if kind == "density" else f"{name}_bias_walk"
            if not np.isfinite(figures).any():
                keys.append(f"# {key} does not show in {lasting}: its default stays")
                continue
            factor = mounted if kind == "density" else 1.0
            times = f", {factor:g} times that at rest" if factor != 1.0 else ", at rest"
            keys.append(f"{key} = {factor * np.nanmax(figures):.3g}  # {unit}{per}{times}")
    lines += textwrap.wrap(MOUNTED, 110)
    return "\n".join([*(f"# {line}" for line in lines), "[robot.filter]", *keys])


def draw(found: Allan, path: Path) -> None:
    """Both sensors' deviations over τ, and what density, flicker and walk make of them, into a picture."""
    # Here: it takes a second, and only a picture needs it.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    for axes, (name, _, unit) in zip(figure.subplots(1, 2), SENSORS, strict=True):
        for noise, label, colour in zip(getattr(found, name), "xyz", ("tab:red", "tab:green", "tab:blue"), strict=True):
            axes.loglog(noise.tau, noise.deviation, "o", color=colour, markersize=4.0, label=label)
            axes.loglog(noise.tau, fitted(noise, noise.tau), "-", color=colour, linewidth=1.0)
        axes.set_xlabel("τ in s")
        axes.set_ylabel(f"Allan deviation in {unit}")
        axes.set_title({"gyro": "gyroscope", "accel": "accelerometer"}[name])
        axes.grid(True, which="both", alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=150)
