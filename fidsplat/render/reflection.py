"""Glossy reflection: the microfacet model GGX with Smith's height-correlated masking (Walter et al. 2007,
Heitz 2014) and the Fresnel factor of a dielectric.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fidsplat.splats.harmonics import C0, MAX_DEGREE, sh_basis
from fidsplat.util.directions import perpendicular, sphere

_VIEW_DIRECTIONS = 256
"""number of directions to which harmonics are fitted"""
_MIN_VIEW_COSINE = 0.05
"""minimum cosine between normal and fitted directions: markers are not legible beyond 87 degrees"""
_LOBE_SAMPLES = 64
"""samples of a reflection"""
_MIN_COSINE = 1e-6
"""cosine to the normal below which a direction is behind the surface"""


class GlossyBrdf(NamedTuple):
    """Specular BRDF of a rough dielectric."""

    roughness: float
    reflectance: float
    """at normal incidence"""

    @property
    def alpha(self) -> float:
        """GGX width of the distribution of microfacet normals."""
        return self.roughness**2

    def reflected(
        self, cosine: np.ndarray, to_viewer: np.ndarray, to_light: np.ndarray, normal: np.ndarray
    ) -> np.ndarray:
        """BRDF times cosine to the light, (n, v): radiance towards each viewer per unit of irradiance
        perpendicular to the light.

        Args:
            cosine: (n, v), between directions to viewers and normals.
            to_viewer, to_light, normal: unit directions (n, v, 3), (n, 3) and (n, 3).
        """
        alpha2 = self.alpha**2
        cos_light = np.einsum("nc,nc->n", to_light, normal)[:, None]
        above = (cosine > _MIN_COSINE) & (cos_light > _MIN_COSINE)
        cos_view, cos_light = np.maximum(cosine, _MIN_COSINE), np.maximum(cos_light, _MIN_COSINE)
        cosine_between = np.einsum("nvc,nc->nv", to_viewer, to_light)
        length = np.sqrt(np.maximum(2 + 2 * cosine_between, 1e-12))
        cosine_half = (cos_view + cos_light) / length
        distribution = alpha2 / (np.pi * (cosine_half**2 * (alpha2 - 1) + 1) ** 2)
        smith_term = 0.5 / (
            cos_light * _smith_root(cos_view, alpha2) + cos_view * _smith_root(cos_light, alpha2)
        )
        # the cosine is between the viewer and the half vector
        factor = fresnel((1 + cosine_between) / length, self.reflectance)
        return np.where(above, distribution * smith_term * factor * cos_light, 0.0)

    def sample(self, to_viewer: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Importance samples of visible normals (Heitz 2018): directions (n, v, k, 3) to incoming light, and
        weights (n, v, k). The sum of weights times radiance is the radiance towards viewers (n, v, 3)."""
        alpha2, i = self.alpha**2, np.arange(_LOBE_SAMPLES)
        radius, phi = np.sqrt((i + 0.5) / _LOBE_SAMPLES), 2 * np.pi * _van_der_corput(_LOBE_SAMPLES)
        axes = np.concatenate([perpendicular(normal), normal[:, None]], 1)
        local = np.einsum("nvd,ncd->nvc", to_viewer, axes)
        stretched = local * (self.alpha, self.alpha, 1.0)
        stretched = (stretched / np.linalg.norm(stretched, axis=-1, keepdims=True))[..., None, :]
        tangent = np.cross((0.0, 0.0, 1.0), stretched)
        length = np.linalg.norm(tangent, axis=-1, keepdims=True)
        tangent = np.where(length > 1e-9, tangent / np.maximum(length, 1e-9), (1.0, 0.0, 0.0))
        bitangent = np.cross(stretched, tangent)
        t1, s = radius * np.cos(phi), (1 + stretched[..., 2]) / 2
        t2 = (1 - s) * np.sqrt(1 - t1**2) + s * (radius * np.sin(phi))
        t3 = np.sqrt(np.maximum(1 - t1**2 - t2**2, 0))
        half_vector = t1[:, None] * tangent + t2[..., None] * bitangent + t3[..., None] * stretched
        half_vector *= (self.alpha, self.alpha, 1.0)
        half_vector[..., 2] = np.maximum(half_vector[..., 2], 1e-9)
        half_vector /= np.linalg.norm(half_vector, axis=-1, keepdims=True)
        local = local[..., None, :]
        cosine = np.sum(local * half_vector, axis=-1, keepdims=True)
        reflected = 2 * cosine * half_vector - local
        cos_light, cos_view = reflected[..., 2], np.maximum(local[..., 2], _MIN_COSINE)
        above = cos_light > _MIN_COSINE
        masking = cos_light * (cos_view + _smith_root(cos_view, alpha2))
        masking = masking / (
            cos_light * _smith_root(cos_view, alpha2) + cos_view * _smith_root(cos_light, alpha2)
        )
        weights = np.where(above, fresnel(cosine[..., 0], self.reflectance) * masking / _LOBE_SAMPLES, 0.0)
        return np.einsum("nvkc,ncd->nvkd", reflected, axes), weights


def fresnel(cosine: np.ndarray, reflectance: float) -> np.ndarray:
    """Fresnel factor of unpolarised light on a dielectric. reflectance: at normal incidence."""
    root = min(np.sqrt(reflectance), 1 - 1e-9)
    index, c = (1 + root) / (1 - root), np.clip(cosine, 0, 1)
    g = np.sqrt(index**2 - 1 + c**2)  # the symbols c and g of Cook and Torrance
    difference, total = g - c, np.maximum(g + c, 1e-12)
    return 0.5 * (difference / total) ** 2 * (1 + ((c * total - 1) / (1 + c * difference)) ** 2)


def _smith_root(cosine: np.ndarray, alpha2: float) -> np.ndarray:
    """Square root in Smith's masking function. alpha2: GGX width squared."""
    return np.sqrt(cosine**2 * (1 - alpha2) + alpha2)


def _van_der_corput(count: int) -> np.ndarray:
    """First `count` numbers of the van der Corput sequence in base 2."""
    bits = np.arange(count)[:, None] >> np.arange(16) & 1
    return bits @ 0.5 ** np.arange(1, 17)


def view_directions(normal: np.ndarray) -> np.ndarray:
    """Unit directions (v, 3) from a surface to viewers, evenly over the hemisphere of its normal (3,)."""
    return sphere(_VIEW_DIRECTIONS, _MIN_VIEW_COSINE) @ np.stack([*perpendicular(normal), normal])


def fit_harmonics(to_viewer: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Fit harmonics (n, 16, 3) of degree 3 to colours (n, v, 3) in directions (v, 3), by least squares with
    minimum norm, as only one hemisphere is given."""
    basis = sh_basis(MAX_DEGREE, -to_viewer)  # harmonics are functions of the direction from camera to splat
    base = colors.mean(axis=1, keepdims=True)
    fitted = np.einsum("kv,nvc->nkc", np.linalg.pinv(basis, rcond=1e-3), colors - base)
    fitted[:, 0] += (base[:, 0] - 0.5) / C0
    return fitted
