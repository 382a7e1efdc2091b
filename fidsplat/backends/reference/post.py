"""Post-processing of rgb: background, and the steps of the sensor model."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.reference.optics import rays_of
from fidsplat.backends.view import View
from fidsplat.capture.environment import Gradient, Panorama
from fidsplat.util.response import linear_light, to_colors

_ROUND = 2e-6
"""relative rounding error of float32 before each step"""


def background_at(view: View, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Background colours (k, 3) at samples with grid positions x, y (k,), 0 without a ray, and their error
    bounds (k,)."""
    around = view.environment_map
    assert around is not None
    rays, valid = rays_of(view, x, y)
    rays = np.where(valid[:, None], rays, 1.0) @ view.rotation
    if isinstance(around, Gradient):
        up = np.array(around.up) / np.linalg.norm(around.up)
        share = np.clip(0.5 + 0.5 * (rays @ up) / np.linalg.norm(rays, axis=1), 0, 1)[:, None]
        colors, bound = (
            np.add(around.bottom, share * np.subtract(around.top, around.bottom)),
            np.zeros(len(x)),
        )
    else:
        colors, bound = _panorama_at(around, rays)
    return np.where(valid[:, None], colors, 0.0), np.where(valid, bound, 0.0)


def max_value(around: Gradient | Panorama | None) -> float:
    if around is None:
        return 0.0
    colors = (around.top, around.bottom) if isinstance(around, Gradient) else around.image
    return float(np.abs(colors).max())


def _panorama_at(panorama: Panorama, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height, width = panorama.image.shape[:2]
    flat = np.hypot(rays[:, 0], rays[:, 2])
    u = (np.arctan2(rays[:, 0], rays[:, 2]) / (2 * np.pi) + 0.5) * width - 0.5
    v = (np.arctan2(rays[:, 1], flat) / np.pi + 0.5) * height - 0.5
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    image = panorama.image.astype(np.float64)

    def at(dx: int, dy: int) -> np.ndarray:
        return image[np.clip(top + dy, 0, height - 1), (left + dx) % width]

    right, bottom = (u - left)[:, None], (v - top)[:, None]
    above, below = at(0, 0) * (1 - right) + at(1, 0) * right, at(0, 1) * (1 - right) + at(1, 1) * right
    # directions are rounded by a few 1e-7 of a circle, which changes the longitude near the poles arbitrarily
    near = np.stack([at(dx, dy) for dx in (-1, 0, 1, 2) for dy in (-1, 0, 1, 2)])
    contrast = (near.max(0) - near.min(0)).max(1)
    off = 1e-6 * (width * np.linalg.norm(rays, axis=1) / np.maximum(flat, 1e-12) + height)
    return above * (1 - bottom) + below * bottom, contrast * np.minimum(off, 1)


def apply_sensor(
    light: np.ndarray, bound: np.ndarray, steps: tuple[str, ...], view: View, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values (k, 3) after the sensor's steps for light (k, 3) at pixels (column x, row y), and their error
    bounds (k,): each step is evaluated at both ends of the interval light +- bound."""
    low, high = light - bound[:, None], light + bound[:, None]
    for step in steps:
        slack = _ROUND * np.maximum(np.abs(low), np.abs(high))
        low, light, high = (_step(step, value, view, x, y) for value in (low - slack, light, high + slack))
        low, high = np.minimum(np.minimum(low, high), light), np.maximum(np.maximum(low, high), light)
    return light, np.maximum(high - light, light - low).max(1)


def _step(name: str, value: np.ndarray, view: View, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    sensor = view.sensor
    inside = np.clip(value, 0, 1)
    match name:
        case "decode_srgb":
            return linear_light(value, "srgb")
        case "veiling_glare":
            rest, *light = sensor.uniforms_of("veiling_glare")
            return value * rest + np.array(light)
        case "saturation":
            return np.minimum(value, sensor.saturation)
        case "white_balance":
            return value * np.array(sensor.uniforms_of("white_balance"))
        case "exposure" | "gain":
            return value * getattr(sensor, name)
        case "vignetting":
            center_x, center_y, scale = view.uniforms_of("vignette_center")
            r2 = ((x + 0.5 - center_x) ** 2 + (y + 0.5 - center_y) ** 2) * scale**2
            a, b, c = sensor.uniforms_of("vignetting")
            return value * np.maximum(1 + a * r2 + b * r2**2 + c * r2**3, 0)[:, None]
        case "noise":
            shot, read, seed = sensor.uniforms_of("noise")
            return value + np.sqrt(np.maximum(value, 0) * shot + read) * variates(x, y, int(seed))
        case "response_gamma":
            return inside ** sensor.uniforms_of("inverse_gamma")[0]
        case "response_srgb":
            return to_colors(inside, "srgb")
        case "response_table":
            curve = np.asarray(sensor.response, np.float32)
            return np.interp(inside, np.linspace(0, 1, len(curve)), curve)
        case "quantise":
            levels = sensor.uniforms_of("quantise_steps")[0]
            return np.rint(inside * levels) / levels
    raise AssertionError(name)


def variates(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Random numbers (k, 3) of mean 0 and variance 1 by pixel and channel, bit-identical to post/noise.cl."""
    columns = []
    for channel in range(3):
        words = [
            word
            for part in (0, 1)
            for word in _pcg4d(x, y, np.full(x.shape, 2 * channel + part), np.full(x.shape, seed))
        ][:6]
        total = sum((word & np.uint32(0xFFFF)).astype(np.int64) + (word >> np.uint32(16)) for word in words)
        columns.append((total - 393210) / 65536)
    return np.stack(columns, 1)


def _pcg4d(*counters: np.ndarray) -> tuple[np.ndarray, ...]:
    """The hash pcg4d (Jarzynski and Olano 2020) of four arrays of uint32."""
    words = (np.asarray(counter).astype(np.uint32) for counter in counters)
    a, b, c, d = (word * np.uint32(1664525) + np.uint32(1013904223) for word in words)
    for last in (False, True):
        a = a + b * d
        b = b + c * a
        c = c + a * b
        d = d + b * c
        if not last:
            a, b, c, d = (word ^ (word >> np.uint32(16)) for word in (a, b, c, d))
    return a, b, c, d
