"""Mirrored and transposed scenes have mirrored and transposed images.

Every rule that treats left and right, top and bottom, or x and y by different lines of code must agree with
the rule of the other side. Pixels are not square, the principal point is aside, and splats reach in from
beyond each side of the image.
"""

import numpy as np
import pytest
from agreement import ALL_OUTPUTS

import fidsplat as fs

SIZE, FOCAL, CENTER = (36, 24), (20.0, 27.0), (14.0, 14.5)
COUNT = 240
LENSES = {
    "pinhole": None,
    "brown_conrady": fs.BrownConrady(k1=-0.05, k2=0.01),
    "fisheye": fs.Fisheye(k1=0.02),
    "orthographic": fs.Orthographic(),
}


def arrays(thick):
    """Splats before the camera, most of them beyond a side of the image."""
    random = np.random.default_rng(6)
    depth = random.uniform(1.0, 3.0, COUNT)
    slopes = random.uniform(-2.2, 2.2, (2, COUNT))
    means = np.column_stack([*(slopes * depth), depth])
    quats = random.normal(size=(COUNT, 4))
    scales = random.uniform(0.1, 0.9, (COUNT, 3 if thick else 2))
    return means, quats, scales, random.uniform(0.1, 0.7, COUNT), random.random((COUNT, 3))


def cloud(parts, way):
    """The splats, mirrored along x or with x and y exchanged."""
    means, quats, scales, opacities, colors = (part.copy() for part in parts)
    w, x, y, z = quats.T
    if way == "mirrored":
        means[:, 0] *= -1
        quats = np.column_stack([w, x, -y, -z])
    elif way == "transposed":
        means = means[:, [1, 0, 2]]
        quats = np.column_stack([w, -y, -x, -z])
        scales[:, :2] = scales[:, 1::-1]  # the splat's own axes are exchanged, too
    return fs.SplatCloud(means, quats, scales, opacities, colors=colors)


def camera(way, lens):
    size, focal, center = SIZE, FOCAL, CENTER
    if lens is not None and lens.kind == "orthographic":
        focal = (6.0, 8.0)
    if way == "mirrored":
        center = (size[0] - center[0], center[1])
    elif way == "transposed":
        size, focal, center = size[::-1], focal[::-1], center[::-1]
    return fs.Camera.pinhole(*size, *focal, *center, lens=lens)


# each kind of splat is on both devices, with half of the lenses
@pytest.mark.parametrize("way", ["mirrored", "transposed"])
@pytest.mark.parametrize("name", list(LENSES))
@pytest.mark.parametrize("kind", ["disks", "ewa", "exact"])
def test_images_follow_their_scenes(renderer, kind, name, way):
    lens = LENSES[name]
    if kind == "ewa" and name in ("brown_conrady", "fisheye"):
        pytest.skip("through lenses 3D Gaussians are exact")
    quality = fs.Quality(ellipsoid="exact" if kind == "exact" else "ewa", projection_precision="float64")
    parts, images = arrays(kind != "disks"), {}
    for each in ("as it is", way):
        frame = renderer.render(cloud(parts, each), camera(each, lens), ALL_OUTPUTS, quality=quality)
        images[each] = {output: np.asarray(frame[output]) for output in ("rgb", "alpha", "depth")}
    for output, image in images["as it is"].items():
        back = images[way][output]
        back = back[:, ::-1] if way == "mirrored" else np.swapaxes(back, 0, 1)
        # the order of equal depths and thresholds may differ in a few pixels
        off = np.abs(back - image) > (1e-3 if output == "depth" else 1e-4)
        assert off.mean() < 0.01, (output, off.mean())
        assert np.unique(image).size > 100
