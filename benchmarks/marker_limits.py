"""Why `fitted` is not opaque: what two ways of making it so reach with Gaussians of opacity 1 at most.

    python benchmarks/marker_limits.py [--device opencl] [--json FILE]

One dimension: cells of one module, dark and light by turns, each made of n Gaussians that are fitted for the
least mean square error, half of it as one layer and half with either colour in front, as centres may order
them; once freely, once with every leak made costly. An axis-parallel template needs about n x n.

A sheet: the dark splats of `fitted` before an opaque sheet of light Gaussians, in the place of the light
splats, by a hundredth of a module or by four, so that centres keep dark in front when tilted. An AprilTag,
12 px a module, over grey; PSNR in dB from the picture of `exact` and least alpha where that is opaque, drawn
by true depth (`standard`) and by the depth of centres (`gsplat`).
Needs scipy.
"""

from __future__ import annotations

import math

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from rich.progress import track
from scipy.optimize import minimize

import fidsplat as fs
from fidsplat.markers import Marker, marker

COUNTS, STARTS, FINE = (5, 7, 9), 4, 480
"""Gaussians of a cell; random starts; samples of a period"""
GREY = 0.5
BEHIND = (0.01, 4.0)
"""modules"""
TEMPLATES = (25, 41, 121)
"""Gaussians of a rectangle; of dark ones alone before a sheet 59 make as many as 31 of both colours"""
TILTS = (0.0, 1.0, 30.0)


def optical_depth(values: np.ndarray, n: int, x: np.ndarray) -> np.ndarray:
    """Of the n Gaussians of a cell around 0 and of those of its colour two, four modules away."""
    place, sigma = values[: n // 2], np.exp(values[n // 2 :])
    places, sigmas = np.concatenate([place, -place, [0.0]]), np.concatenate([sigma[:-1], sigma])
    total = np.zeros(len(x))
    for shift in (-4, -2, 0, 2, 4):
        u = (x - places[:, None] - shift) / sigmas[:, None]
        total -= np.log1p(-0.99999 * np.exp(-0.5 * u * u)).sum(0)
    return total


def pictures(values: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Darkness over grey as one layer and with dark in front, and alpha, over one period."""
    x = (np.arange(FINE) + 0.5) / FINE * 2 - 1
    dark = optical_depth(values, n, x)
    light = np.roll(dark, FINE // 2)
    left = np.exp(-dark - light)
    layer = (1 - left) * dark / np.maximum(dark + light, 1e-300) + left * GREY
    return layer, 1 - np.exp(-dark) + left * GREY, 1 - left


def row_of_cells(n: int, costly: bool) -> dict:
    """What n Gaussians of a cell reach."""
    ideal = np.abs((np.arange(FINE) + 0.5) / FINE * 2 - 1) < 0.5

    def loss(values: np.ndarray) -> float:
        layer, ordered, alpha = pictures(values, n)
        error = np.mean((layer - ideal) ** 2) + np.mean((ordered - ideal) ** 2)
        leaks = np.mean(np.maximum(0.9995 - alpha, 0)) if costly else 0.0
        return float(500 * error + 1000 * leaks)

    found = []
    for seed in range(STARTS):
        near = 0.5 * 2.0 ** -np.sort(np.random.default_rng(seed).uniform(0.2, 4.0, n // 2))
        start = np.concatenate([0.5 - near, np.log(0.5 * near + 0.01), [math.log(0.2)]])
        bounds = [(0.0, 0.7)] * (n // 2) + [(math.log(0.004), math.log(0.6))] * (n // 2 + 1)
        found.append(minimize(loss, start, bounds=bounds, method="L-BFGS-B", options={"maxiter": 400}))
    layer, ordered, alpha = pictures(min(found, key=lambda one: one.fun).x, n)
    return {
        "n": n,
        "opaque": costly,
        "layer_db": decibels(layer - ideal),
        "ordered_db": decibels(ordered - ideal),
        "least_alpha": float(alpha.min()),
    }


def decibels(error: np.ndarray) -> float:
    return -10 * math.log10(float((error * error).mean()))


def before_a_sheet(made: Marker, behind: float) -> fs.SplatCloud:
    """The dark splats of a marker, `behind` modules before a sheet of light ones, a module apart and wide."""
    dark = made.cloud.colors[:, 0] < 0.5 if made.cloud.colors is not None else np.zeros(0, bool)
    parts = {name: getattr(made.cloud, name)[dark] for name in ("means", "quats", "scales", "opacities")}
    front = fs.SplatCloud(**parts, colors=np.zeros((int(dark.sum()), 3)))
    side = made.grid.shape[0]
    at = (
        np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) + 0.5 - side / 2
    ) * made.module
    n = len(at)
    means = np.column_stack([at, np.full(n, behind * made.module)])
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    sheet = fs.SplatCloud(means, quats, np.full((n, 2), made.module), np.ones(n), colors=np.ones((n, 3)))
    return fs.SplatCloud.concatenate([front.with_planes(0), sheet.with_planes(0)])


def camera(made: Marker, tilt: float) -> fs.Camera:
    """Far away, the marker leaning back, a module 12 px long."""
    side, distance = 12 * made.grid.shape[0] + 40, 40 * made.size
    pose, angle = np.eye(4), math.radians(tilt)
    pose[1:3, 1:3] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    pose[2, 3] = distance
    focal = 12 * distance / made.module
    return fs.Camera.pinhole(side, side, focal, focal, side / 2, side / 2, pose)


def sheet_rows(renderer: fs.Renderer) -> list[dict]:
    """Both colours side by side, and dark before a sheet."""
    exact = marker("apriltag:36h11:0")
    ways: dict[str, fs.SplatCloud] = {}
    for size in TEMPLATES:
        made = marker("apriltag:36h11:0", mixture="fitted", template=size)
        ways[f"both colours, {size}"] = made.cloud
        for behind in BEHIND:
            ways[f"dark {size}, {behind:g} before a sheet"] = before_a_sheet(made, behind)
    rows = []
    for name, cloud in track(ways.items(), "pictures", console=PROGRESS):
        for quality in ("standard", "gsplat"):
            for tilt in TILTS:
                view = camera(exact, tilt)
                ideal = renderer.render(exact.cloud, view, ("rgb", "alpha"), background=(GREY,) * 3)
                frame = renderer.render(cloud, view, ("rgb", "alpha"), quality, background=(GREY,) * 3)
                inside = ideal["alpha"] > 0.9999
                rows.append(
                    {
                        "way": name,
                        "splats": len(cloud),
                        "quality": quality,
                        "tilt_deg": tilt,
                        "psnr_db": decibels((frame["rgb"] - ideal["rgb"])[inside]),
                        "least_alpha": float(frame["alpha"][inside].min()),
                    }
                )
    return rows


def main() -> None:
    asked = options(__doc__).parse_args()
    renderer = fs.Renderer(asked.device)
    sheets = sheet_rows(renderer)
    cells = [row_of_cells(n, costly) for n in COUNTS for costly in (False, True)]
    if keep({**facts(renderer), "cells": cells, "sheets": sheets}, asked.json):
        return
    show("A row of cells", list(cells[0]), [[_text(value) for value in row.values()] for row in cells])
    show(renderer.device.title, list(sheets[0]), [[_text(value) for value in row.values()] for row in sheets])


def _text(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
