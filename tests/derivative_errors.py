"""A device's derivatives against the reference's: random images, a random loss, how far off they are."""

from __future__ import annotations

import hashlib
import math
import pickle
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from fidsplat.backends.gradients import on_host
from fidsplat.backends.interface import Backend
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference.backend import ReferenceBackend
from fidsplat.backends.reference.blend import MIN_ALPHA
from fidsplat.backends.reference.error_bounds import STOP
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.effects import FeatureSet
from fidsplat.effects.differentiable import with_distortion
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.splats.cloud import SplatCloud

NORM, COSINE = 1e-4, 1e-6
"""largest error of a device, as in `Difference`, where the derivatives are not worse conditioned"""
_ROUNDINGS = 8
"""float32 roundings of a moment (a fragment's term and the sums over a tile), as many as 64 random ones"""
_BEHIND = (0.3, 0.6, 0.1)
_ORIGIN = (40.0, -25.0, 7.0)
"""of the clouds, metres: a derivative by a world position instead of one relative to it shows"""


class Difference(NamedTuple):
    """For the complete array of one parameter."""

    parameter: str
    norm: float
    """of the difference, relative to the truth's"""
    turned: float
    """one less the cosine of both"""


def random_scene(
    seed: int,
    count: int = 90,
    size: tuple[int, int] = (61, 43),
    degree: int | None = 1,
    outputs: tuple[str, ...] = ("rgb", "alpha", "depth", "normal"),
    quality: Any = None,
    origin: tuple[float, float, float] = _ORIGIN,
    solid: float = 0.0,
    **splats: Any,
) -> tuple[SplatCloud, Capture]:
    """Random splats and a camera whose pixels are not square and whose principal point is not the centre.

    origin: of the cloud, by default far from the world's. solid: share of 3D Gaussians. splats: arguments of
    `random_splats`.
    """
    cloud = random_splats(count, seed, sh_degree=degree, **splats)
    means, quats, scales, opacities = arrays_of(cloud)
    if solid:
        third = np.where(np.arange(count) < solid * count, np.roll(scales[:, 0], 1), 0)
        scales = np.column_stack([scales, third])
    cloud = SplatCloud(means, quats, scales, opacities, origin=np.array(origin), **colors_of(cloud))
    eye = np.random.default_rng(seed).uniform(-0.3, 0.3, 3) + origin
    camera = stretched(Camera.look_at(*size, 1.1, eye, np.add(origin, (0.0, 0.1, 3.0))))
    return cloud, Capture(camera, outputs=outputs, quality=quality, background=_BEHIND)


def stretched(camera: Camera) -> Camera:
    """The pinhole camera with fy = 1.3 fx and a principal point off the centre."""
    fx, (cx, cy) = camera.fx, (camera.cx + 1.5, camera.cy - 0.75)
    matrix, position = camera.world_to_camera, camera.position
    return Camera.pinhole(camera.width, camera.height, fx, 1.3 * fx, cx, cy, matrix, position=position)


def arrays_of(cloud: SplatCloud) -> tuple[np.ndarray, ...]:
    """Means, quats, scales and opacities."""
    return cloud.means, cloud.quats, cloud.scales, cloud.opacities


def colors_of(cloud: SplatCloud) -> dict[str, Any]:
    """Colours or harmonics, as arguments of a cloud."""
    return {"colors": cloud.colors} if cloud.sh is None else {"sh": cloud.sh}


def random_loss(features: FeatureSet, view: View, seed: int = 0) -> dict[str, np.ndarray]:
    """Derivatives of a loss by the images, float32, of a normal distribution."""
    rng = np.random.default_rng(seed)
    shapes = {one.name: (3,) if one.channels == 3 else () for one in features.images}
    return {
        name: rng.normal(size=(view.height, view.width, *shape)).astype(np.float32)
        for name, shape in shapes.items()
    }


def derivatives(
    backend: Backend,
    cloud: SplatCloud,
    capture: Capture,
    by_images: Mapping[str, np.ndarray] | None = None,
    distorted: bool = True,
    **build: Any,
) -> dict[str, np.ndarray]:
    """An image's derivatives in NumPy; those of a random loss unless `by_images` says by which images.

    distorted: images of depths have their distortion too. build: further arguments of
    `Backend.gradient_pipeline`.
    """
    features, view = prepare(cloud, capture)
    if distorted and "depth" in features.names:
        features = with_distortion(features)
    pipeline = backend.gradient_pipeline(features, **build)
    images = pipeline.forward(backend.upload(cloud), view)
    given = random_loss(features, view) if by_images is None else by_images
    gradients = pipeline.backward(images, given)
    # the reference's stay float64
    return {name: one if isinstance(one, np.ndarray) else on_host(one) for name, one in gradients.items()}


_TRUTHS: dict[bytes, dict[str, np.ndarray]] = {}


def reference_derivatives(
    cloud: SplatCloud, capture: Capture, by_images: Mapping[str, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """The derivatives of the reference, cached for all devices and schedules."""
    key = hashlib.sha256(pickle.dumps((cloud, capture, by_images))).digest()
    if key not in _TRUTHS:
        _TRUTHS[key] = derivatives(ReferenceBackend(), cloud, capture, by_images)
    return _TRUTHS[key]


def certain_loss(cloud: SplatCloud, capture: Capture) -> dict[str, np.ndarray]:
    """`random_loss` with the distortion of depths. Depths and normals of pixels whose coverage rounding may
    move across `MIN_ALPHA`, where they end, have no derivative to compare: their weight is 0."""
    features, view = prepare(cloud, capture)
    if "depth" in features.names:
        features = with_distortion(features)
    loss = random_loss(features, view)
    reference, (covered, _) = ReferenceBackend(), prepare(cloud, capture.with_(outputs=("alpha",)))
    alpha = reference.pipeline(covered).render_view(reference.upload(cloud), view).read("alpha", 0)
    for name in {"depth", "normal"} & loss.keys():
        loss[name][np.abs(alpha - MIN_ALPHA) <= STOP] = 0
    return loss


def conditioning(
    cloud: SplatCloud, capture: Capture, by_images: Mapping[str, np.ndarray]
) -> list[Difference]:
    """Estimate of the largest change of the reference's derivatives if each number of means and quaternions
    moves by at most one unit in the last place of float32.

    Records of splats are rounded to float32, which turns and moves them by such amounts: no device has the
    derivatives of needles more exactly. The numbers are moved one after another, for all splats at once, and
    the changes added up: moved together, those of a single needle may cancel.
    """
    expected = reference_derivatives(cloud, capture, by_images)
    third = [] if cloud.thickness is None else [cloud.thickness]
    scales, rng = np.column_stack([cloud.scales, *third]), np.random.default_rng(0)
    changes = []
    for column in range(7):
        numbers = np.column_stack([cloud.means, cloud.quats])
        towards = rng.choice(np.array([-np.inf, np.inf], np.float32), len(cloud))
        numbers[:, column] = np.nextafter(numbers[:, column], towards)
        arrays = numbers[:, :3], numbers[:, 3:], scales, cloud.opacities
        moved = SplatCloud(*arrays, origin=cloud.origin, **colors_of(cloud))
        changes.append(differences(derivatives(ReferenceBackend(), moved, capture, by_images), expected))
    return [
        Difference(
            of[0].parameter,
            sum(one.norm for one in of),
            # angles add up; `turned` is half of an angle's square
            sum(math.sqrt(max(one.turned, 0)) for one in of) ** 2,
        )
        for of in zip(*changes, strict=True)
    ]


def rotation_floor(cloud: SplatCloud, reference: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Absolute error of the quaternions' derivative by rounding of moments, for `differences`.

    A rotation exchanges covariance between two axes: its derivative is a difference of terms as large as the
    derivatives by their ln(scales), and 0 for spheres. Moments are float32, with an error of 2^-24 of these
    terms for each rounding. A quaternion of length 1 turns by twice its change.
    """
    if cloud.thickness is None:
        return {}
    third = reference["thickness"] * cloud.thickness
    by_log = np.column_stack([reference["scales"] * cloud.scales, third])
    terms = 2 * np.linalg.norm(by_log, axis=1) / np.linalg.norm(cloud.quats, axis=1)
    return {"quats": 2.0**-24 * _ROUNDINGS * float(np.linalg.norm(terms[cloud.thickness > 0]))}


def differences(
    found: Mapping[str, np.ndarray],
    truth: Mapping[str, np.ndarray],
    floors: Mapping[str, float] | None = None,
) -> Iterator[Difference]:
    """How far each array of `found` is from the reference's; where that is 0 all over, anything else is
    infinitely far. floors: absolute errors that count as 0, by parameter."""
    for name, expected in truth.items():
        got, length = found[name].astype(np.float64), float(np.linalg.norm(expected))
        off = float(np.linalg.norm(got - expected))
        if off <= (floors or {}).get(name, 0.0):
            yield Difference(name, 0.0, 0.0)
            continue
        if length == 0 or not np.any(got):
            yield Difference(name, np.inf, 0.0)
            continue
        cosine = float((got * expected).sum() / (length * np.linalg.norm(got)))
        yield Difference(name, off / length, 1 - cosine)
