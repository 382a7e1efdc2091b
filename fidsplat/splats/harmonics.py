"""Real spherical harmonics of degree 0 to 3, with the signs, order and constants of 3DGS, gsplat and 2DGS."""

from collections.abc import Mapping

import numpy as np

from fidsplat.util.directions import sphere
from fidsplat.util.errors import InputError

C0 = 0.28209479177387814
"""Y_00; a colour c is the degree 0 coefficient (c - 0.5) / C0."""
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
MAX_DEGREE = 3


def sh_basis(degree: int, dirs: np.ndarray) -> np.ndarray:
    """Basis values (n, k) float64, k = (degree + 1)^2, for unit directions (n, 3).

    Colour of a splat: max(0, 0.5 + sum_k basis[k] * sh[k]), where the direction runs from the camera's
    position to the splat's centre, in the world frame. Raises InputError for a degree outside 0..3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise InputError(f"SH degree must be 0 to {MAX_DEGREE}, got {degree}")
    x, y, z = np.asarray(dirs, np.float64).T
    columns = [np.full(x.shape, C0)]
    if degree >= 1:
        columns += [-_C1 * y, _C1 * z, -_C1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        columns += [
            _C2[0] * x * y,
            _C2[1] * y * z,
            _C2[2] * (2 * zz - xx - yy),
            _C2[3] * x * z,
            _C2[4] * (xx - yy),
        ]
    if degree >= 3:
        columns += [
            _C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            _C3[4] * x * (4 * zz - xx - yy),
            _C3[5] * z * (xx - yy),
            _C3[6] * x * (xx - 3 * yy),
        ]
    return np.stack(columns, axis=1)


def colors_of_degree(arrays: Mapping[str, np.ndarray], sh_degree: int) -> dict[str, np.ndarray]:
    """`colors` or `sh` converted to an SH degree, with 0 for missing degrees; degree -1: plain colours.

    arrays: those of a cloud, with `means`, and `colors` or `sh`; for degree -1, `sh` must have degree 0.
    """
    if sh_degree < 0:
        if "colors" in arrays:
            return {"colors": arrays["colors"]}
        return {"colors": np.maximum(np.float32(C0) * arrays["sh"][:, 0] + np.float32(0.5), np.float32(0))}
    terms = (sh_degree + 1) ** 2
    if "sh" in arrays and arrays["sh"].shape[1] == terms:
        return {"sh": arrays["sh"]}
    sh = np.zeros((len(arrays["means"]), terms, 3), np.float32)
    if "sh" in arrays:
        common = min(terms, arrays["sh"].shape[1])
        sh[:, :common] = arrays["sh"][:, :common]
    else:
        with np.errstate(over="ignore"):  # colours of a damaged store
            sh[:, 0] = (arrays["colors"].astype(np.float64) - 0.5) / C0
    return {"sh": sh}


def color_range(colors: np.ndarray | None, sh: np.ndarray | None) -> tuple[float, float]:
    """Bounds, at most 0 and at least 0, on all channels of colours (n, 3), or of SH (n, k, 3) over all
    directions. Values that are not finite are ignored.

    The squared basis values of band l sum to (2 l + 1) / (4 pi), so that a band is at most the square root of
    this sum times the norm of its coefficients.
    """
    if sh is None:
        values = np.zeros(0) if colors is None else colors[np.isfinite(colors)]
        return float(values.min(initial=0.0)), float(values.max(initial=0.0))
    highest = np.full((len(sh), 3), 0.5)
    for band in range(int(np.sqrt(sh.shape[1]))):
        coefficients = sh[:, band**2 : (band + 1) ** 2]
        squares = np.einsum("nkc,nkc->nc", coefficients, coefficients, dtype=np.float64)
        highest += np.sqrt((2 * band + 1) / (4 * np.pi) * squares)
    return 0.0, float(highest[np.isfinite(highest)].max(initial=0.0))


def rotation_of_coefficients(degree: int, rotation: np.ndarray) -> np.ndarray:
    """Matrix D (k, k) float64 that rotates SH coefficients by R (3, 3): basis(R d) D f = basis(d) f.

    D is block diagonal; least squares over fixed directions yield the block of each band.
    """
    dirs = sphere(32)  # enough for a well-conditioned solution
    before, after = sh_basis(degree, dirs), sh_basis(degree, dirs @ np.asarray(rotation, np.float64).T)
    result = np.zeros((before.shape[1],) * 2)
    for band in range(degree + 1):
        part = slice(band * band, (band + 1) * (band + 1))
        result[part, part] = np.linalg.lstsq(after[:, part], before[:, part], rcond=None)[0]
    return result
