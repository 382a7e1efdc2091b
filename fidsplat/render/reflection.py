"""Reflection of light by a surface: Lambert's law, and gloss by the microfacet model GGX.

GGX with Smith's height-correlated masking (Walter et al. 2007, Heitz 2014) and Fresnel's factor of a
dielectric.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fidsplat.splats.harmonics import C0, MAX_DEGREE, sh_basis
from fidsplat.util.directions import perpendicular, sphere

_DIRECTIONS = 256
_GRAZING = 0.05
"""minimum cosine between normal and fitted directions: markers are not legible beyond 87 degrees"""
_LOBE = 64
_BELOW = 1e-6


class Gloss(NamedTuple):
    """A glossy surface."""

    roughness: float
    reflectance: float
    """at normal incidence"""

    @property
    def alpha(self) -> float:
        """GGX width of the distribution of microfacet normals."""
        return self.roughness**2


def fresnel(cosine: np.ndarray, reflectance: float) -> np.ndarray:
    """Fresnel factor of unpolarised light on a dielectric. reflectance: at normal incidence."""
    root = min(np.sqrt(reflectance), 1 - 1e-9)
    index, cosine = (1 + root) / (1 - root), np.clip(cosine, 0, 1)
    inner = np.sqrt(index**2 - 1 + cosine**2)
    mirrored, along = inner - cosine, np.maximum(inner + cosine, 1e-12)
    across = 1 + cosine * mirrored
    return 0.5 * (mirrored / along) ** 2 * (1 + ((cosine * along - 1) / across) ** 2)


def gloss(
    cosine: np.ndarray, to_viewer: np.ndarray, to_light: np.ndarray, normal: np.ndarray, surface: Gloss
) -> np.ndarray:
    """Reflected radiance (n, v) towards viewers (n, v, 3) per irradiance of a surface that faces the light:
    the BRDF times the cosine of the light. cosine: (n, v) of viewer and normal (n, 3); to_light: (n, 3)."""
    square = surface.alpha**2
    light = np.einsum("nc,nc->n", to_light, normal)[:, None]
    above = (cosine > _BELOW) & (light > _BELOW)
    view, light = np.maximum(cosine, _BELOW), np.maximum(light, _BELOW)
    along = np.einsum("nvc,nc->nv", to_viewer, to_light)
    length = np.sqrt(np.maximum(2 + 2 * along, 1e-12))
    half = (view + light) / length
    distribution = square / (np.pi * (half**2 * (square - 1) + 1) ** 2)
    masking = 0.5 / (light * _slope(view, square) + view * _slope(light, square))
    # the cosine is between viewer and half vector
    factor = fresnel((1 + along) / length, surface.reflectance)
    return np.where(above, distribution * masking * factor * light, 0.0)


def lobe(to_viewer: np.ndarray, normal: np.ndarray, surface: Gloss) -> tuple[np.ndarray, np.ndarray]:
    """Importance samples of the reflection: directions (n, v, k, 3) towards incoming light, and weights (n,
    v, k). The sum of weights times radiance is the radiance towards viewers (n, v, 3). Visible normals are
    sampled (Heitz 2018)."""
    square, i = surface.alpha**2, np.arange(_LOBE)
    radius, angle = np.sqrt((i + 0.5) / _LOBE), 2 * np.pi * _van_der_corput(_LOBE)
    axes = np.concatenate([perpendicular(normal), normal[:, None]], 1)
    local = np.einsum("nvd,ncd->nvc", to_viewer, axes)
    stretched = local * (surface.alpha, surface.alpha, 1.0)
    stretched = (stretched / np.linalg.norm(stretched, axis=-1, keepdims=True))[..., None, :]
    first = np.cross((0.0, 0.0, 1.0), stretched)
    across = np.linalg.norm(first, axis=-1, keepdims=True)
    first = np.where(across > 1e-9, first / np.maximum(across, 1e-9), (1.0, 0.0, 0.0))
    second = np.cross(stretched, first)
    one, share = radius * np.cos(angle), (1 + stretched[..., 2]) / 2
    two = (1 - share) * np.sqrt(1 - one**2) + share * (radius * np.sin(angle))
    three = np.sqrt(np.maximum(1 - one**2 - two**2, 0))
    half = one[:, None] * first + two[..., None] * second + three[..., None] * stretched
    half *= (surface.alpha, surface.alpha, 1.0)
    half[..., 2] = np.maximum(half[..., 2], 1e-9)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    local = local[..., None, :]
    cosine = np.sum(local * half, axis=-1, keepdims=True)
    found = 2 * cosine * half - local
    light, view = found[..., 2], np.maximum(local[..., 2], _BELOW)
    above = light > _BELOW
    masking = light * (view + _slope(view, square))
    masking = masking / (light * _slope(view, square) + view * _slope(light, square))
    weights = np.where(above, fresnel(cosine[..., 0], surface.reflectance) * masking / _LOBE, 0.0)
    return np.einsum("nvkc,ncd->nvkd", found, axes), weights


def _slope(cosine: np.ndarray, square: float) -> np.ndarray:
    return np.sqrt(cosine**2 * (1 - square) + square)


def _van_der_corput(count: int) -> np.ndarray:
    """First numbers (count,) of the van der Corput sequence in base 2."""
    bits = np.arange(count)[:, None] >> np.arange(16) & 1
    return bits @ 0.5 ** np.arange(1, 17)


def view_directions(normal: np.ndarray) -> np.ndarray:
    """Unit directions (v, 3) from a surface to viewers, evenly over the hemisphere of its normal (3,)."""
    return sphere(_DIRECTIONS, _GRAZING) @ np.stack([*perpendicular(normal), normal])


def fit_harmonics(to_viewer: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Fit harmonics (n, 16, 3) of degree 3 to colours (n, v, 3) in directions (v, 3), by least squares with
    minimum norm, as only one hemisphere is given."""
    basis = sh_basis(MAX_DEGREE, -to_viewer)  # harmonics are functions of the direction from camera to splat
    base = colors.mean(axis=1, keepdims=True)
    fitted = np.einsum("kv,nvc->nkc", np.linalg.pinv(basis, rcond=1e-3), colors - base)
    fitted[:, 0] += (base[:, 0] - 0.5) / C0
    return fitted
