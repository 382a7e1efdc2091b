"""Response curve of a camera, from linear light to colours, and its inverse, without a clamp at 1."""

from __future__ import annotations

import numpy as np


def linear_light(colors: np.ndarray, response: str | float, dtype: type = np.float64) -> np.ndarray:
    """Linear light of colours, computed in `dtype`; the sRGB curve is extended above 1."""
    colors = np.maximum(np.asarray(colors, dtype), 0)
    if response == "linear":
        return colors
    if response == "srgb":
        return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return colors ** float(response)


def to_colors(light: np.ndarray, response: str | float) -> np.ndarray:
    """Colours of linear light, the inverse of `linear_light`."""
    light = np.maximum(np.asarray(light, np.float64), 0)
    if response == "linear":
        return light
    if response == "srgb":
        return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return light ** (1 / float(response))
