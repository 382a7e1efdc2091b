"""Self-test group B: arithmetic of the ray-splat intersection."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest.agreement import (
    ALL_OUTPUTS,
    COLOR_TOLERANCE,
    FrameSpec,
    differing,
    reference_images,
    render,
)
from fidsplat.selftest.case import Finding, Found, case
from fidsplat.selftest.clouds import camera, quaternion, rotation, splats
from fidsplat.splats.cloud import SplatCloud

WIDTH, HEIGHT, FOCAL = 8192, 5461, 6400.0
QUALITY = Quality(lowpass="none", alpha_cutoff=1e-6)
"""quality without low-pass; its cut-off at 5.3 standard deviations is outside of the measured pixels"""
CUT = 1.0 / 255.0
SHIFT = np.array([5e5, 4.5e6, 300.0])
"""metres: a position in UTM coordinates"""
EDGE_ON = quaternion((0, 1, 0), (0, 0, 1))
"""quaternion of a splat that is edge-on to the camera: tangents along y and z"""
FACING = (1.0, 0.0, 0.0, 0.0)


def grazing_errors(renderer: Renderer, tilt: float, sigma: int, quality: Quality = QUALITY) -> np.ndarray:
    """Errors (k,) of the Gaussian in at most 4,000 pixels within 3.3 standard deviations of opaque splats.

    The splats are in a strip at the lower right corner of a large image; only the strip is rendered. tilt:
    degrees between the splat's normal and the ray to its centre. sigma: standard deviation in pixels of the
    untilted splat.
    """
    generator = np.random.default_rng(int(tilt * 10) + sigma)
    cell = math.ceil(11 * sigma)
    rows = 4 if sigma < 10 else 1
    columns = 3200 // cell
    strip = rows * cell
    view = camera(WIDTH, strip, FOCAL, cy=HEIGHT / 2 - (HEIGHT - strip))
    flatness = math.cos(math.radians(tilt))
    means, quats, scales = [], [], []
    for j in range(rows):
        for i in range(columns):
            # offset from a pixel centre by up to the projected width of a grazing splat
            x, y = (
                (np.array([WIDTH - (i + 1) * cell, j * cell]) + cell // 2)
                + 0.5
                + generator.uniform(-1.5, 1.5, 2) * min(1.0, sigma * flatness)
            )
            ray = np.array([(x - view.cx) / FOCAL, (y - view.cy) / FOCAL, 1.0])
            depth = generator.uniform(3, 60)
            means.append(ray * depth)
            quats.append(_tilted(generator, ray, tilt, flatness))
            scales.append(sigma * depth / FOCAL)
    cloud = splats(np.asarray(means, np.float32), quats, np.asarray(scales)[:, None])
    spec = FrameSpec(cloud, view, quality, ("rgb", "alpha"))
    alpha = render(renderer, spec)["alpha"]
    covered = np.nonzero(alpha > 0)
    sampled = generator.permutation(len(covered[0]))[:4000]
    covered = covered[0][sampled], covered[1][sampled]
    expected = reference_images(spec, covered)["alpha"]
    errors = np.abs(alpha[covered] - expected)[expected > 0.004]
    return errors


def _tilted(generator: np.random.Generator, ray: np.ndarray, tilt: float, flatness: float) -> np.ndarray:
    """Quaternion (4,) of a tilted splat whose untilted tangent connects pixel centres, within flatness."""
    along = generator.choice([[1, 0], [0, 1], [1, 1], [2, 1], [-1, 2], [3, -1], [-2, 3], [4, 3]]).astype(
        float
    )
    along += generator.uniform(-2, 2, 2) * flatness
    # direction in the camera frame that is perpendicular to the ray and projects to `along`
    w = -(along @ ray[:2]) / (ray @ ray)
    tangent = np.array([*(along + ray[:2] * w), w])
    tangent /= np.linalg.norm(tangent)
    along = ray / np.linalg.norm(ray)
    angle = math.radians(tilt)
    normal = math.cos(angle) * along + math.sin(angle) * np.cross(tangent, along)
    return quaternion(tangent, np.cross(normal, tangent))


@case("B1", "cancellation in pixel coordinates", "8192 px wide, tilts to 89.9 deg at its far corner")
def b1(renderer: Renderer) -> Found:
    for tilt, bound in ((0.0, 1e-4), (60.0, 1e-4), (85.0, 1e-4), (89.9, 1e-3)):
        for sigma in (3, 30):
            errors = grazing_errors(renderer, tilt, sigma)
            what = f"error of G at {tilt:g} deg and {sigma} px"
            yield Finding(what, float(errors.max(initial=0.0)), bound)
            yield Finding("missing pixels of 500 measured ones", max(0.0, 500 - len(errors)), 0)


def _edge_on(angle: float) -> FrameSpec:
    """A splat at 3 m whose plane is at `angle` radians to the ray; its centre projects to (16.2, 12.4)."""
    position = 3 * math.sin(angle), 0.0, -3 * math.cos(angle)
    view = Camera.look_at(32, 24, 0.6, position, (0, 0, 0))
    moved = Camera.pinhole(32, 24, view.fx, view.fy, 16.2, 12.4, view.world_to_camera, position=position)
    return FrameSpec(splats([[0, 0, 0]], EDGE_ON, 0.3, 0.9), moved, outputs=ALL_OUTPUTS)


@case("B2", "edge-on", "0, 1e-7, 1e-4, 1e-2 rad to the plane; steps of 1e-6")
def b2(renderer: Renderer) -> Found:
    for angle in (0.0, 1e-7, -1e-7, 1e-4, -1e-4, 1e-2, -1e-2):
        yield _edge_on(angle)
    # exactly edge-on, and the camera inside of the disk
    yield FrameSpec(splats([[0, 0, 3]], EDGE_ON, 0.3, 0.9), camera(33, 25, 40.0), outputs=ALL_OUTPUTS)
    yield FrameSpec(splats([[0, 0, 0.5]], EDGE_ON, 1.0, 0.9), camera(33, 25, 40.0), outputs=ALL_OUTPUTS)
    frames = [render(renderer, _edge_on(step * 1e-6)) for step in range(-12, 13)]
    alpha = np.stack([frame["alpha"] for frame in frames])
    finite = all(np.isfinite(frame[name]).all() for frame in frames for name in ALL_OUTPUTS)
    yield Finding("jump of alpha in steps of 1e-6 rad", float(np.abs(np.diff(alpha, axis=0)).max()), 1e-3)
    center = float(alpha[:, 12, 16].min())
    yield Finding("alpha missing at the centre", 0.9 * math.exp(-(0.3**2 + 0.1**2)) - center, COLOR_TOLERANCE)
    yield Finding("non-finite outputs", float(not finite), 0)


@case("B3", "low-pass filter", "splats of 1e-4 px; 300 splats at 50 to 200 m")
def b3(renderer: Renderer) -> Found:
    crowd = random_splats(300, seed=6, depth=(50.0, 200.0), scale=(1e-4, 1e-2), across=60.0)
    yield FrameSpec(crowd, camera(), outputs=ALL_OUTPUTS)
    yield FrameSpec(
        splats([[0.01, 0.02, 4]], rotation((1, 0, 0), 70), 0.03, 0.8), camera(), outputs=ALL_OUTPUTS
    )
    # a splat without extent is its opacity times exp(-d^2) within the cut-off radius
    view = camera(31, 31, 100.0)
    error = 0.0
    rows, columns = np.mgrid[0:31, 0:31] + 0.5
    for x, y, opacity in ((15.5, 15.5, 1.0), (14.9, 16.2, 0.7), (16.0, 15.0, 0.05)):
        means = [[(x - view.cx) / 100, (y - view.cy) / 100, 1]]
        alpha = render(renderer, FrameSpec(splats(means, FACING, 1e-7, opacity), view))["alpha"]
        square = (columns - x) ** 2 + (rows - y) ** 2
        inside = square <= math.log(opacity / CUT)
        rim = np.abs(square - math.log(opacity / CUT)) < 1e-4  # decided by the rounding of the centre
        want = np.where(inside, opacity * np.exp(-square), 0.0)
        error = max(error, float(np.abs(alpha - want)[~rim].max()))
    yield Finding("error against exp(-d^2)", error, COLOR_TOLERANCE)


@case("B4", "depth of grazing and thin splats", "tilts of 60, 89, 89.99 and 90 deg")
def b4(renderer: Renderer) -> Found:
    for degrees in (89.0, 89.99, 90.0):
        cloud = splats([[0.1, 0.05, 4]], rotation((0, 1, 0), degrees), (1e-3, 5e-3))
        yield FrameSpec(cloud, camera(), outputs=ALL_OUTPUTS)
    # compare the depth of a tilted wall with its plane; no depth may exceed the largest of the disk
    view = camera()
    wall = rotation((0.3, 1, 0), 60)
    cloud = splats([[0, 0, 5]], wall, 1.0)
    rows, columns = np.mgrid[0:80, 0:100] + 0.5
    rays = np.stack([(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], -1)
    w, x, y, z = cloud.quats[0].astype(float)
    normal = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    want = (normal @ [0, 0, 5]) / (rays @ normal)
    depth = render(renderer, FrameSpec(cloud, view, outputs=("depth",)))["depth"]
    visible = depth > 0
    error = np.abs(depth / want - 1)[visible].max()
    yield Finding("relative depth error of a tilted plane", float(error), 1e-4)
    needle = splats([[0.1, 0.05, 4]], rotation((0, 1, 0), 89.99), (1e-3, 5e-3))
    extent = math.sqrt(2 * math.log(255)) * 5e-3
    depth = render(renderer, FrameSpec(needle, view, outputs=("depth",)))["depth"]
    yield Finding("depth beyond that of the disk [m]", float(depth.max()) - 4 - extent, 1e-5)


def _shifted(shift: np.ndarray) -> FrameSpec:
    """A cloud and a camera, both translated by `shift`."""
    cloud = random_splats(150, seed=8, depth=(1.0, 6.0), scale=(1e-2, 0.5))
    origin, position, target = np.add(shift, ((0.5, -0.25, 2.0), (0.25, -0.125, -0.5), (0.75, 0.5, 6.0)))
    arrays = {"colors": cloud.colors, "labels": cloud.labels, "origin": origin}
    cloud = SplatCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, **arrays)
    return FrameSpec(cloud, Camera.look_at(100, 80, 1.0, position, target), outputs=ALL_OUTPUTS)


@case("B5", "far from the world origin", "camera and cloud at (5e5, 4.5e6, 300) m")
def b5(renderer: Renderer) -> Found:
    yield _shifted(SHIFT)
    # float64 means without an origin are made relative to one
    near = _shifted(np.zeros(3)).cloud
    means = near.world_means() + SHIFT
    cloud = SplatCloud(means, near.quats, near.scales, near.opacities, colors=near.colors, labels=near.labels)
    yield FrameSpec(cloud, _shifted(SHIFT).camera, outputs=ALL_OUTPUTS)
    here, there = (render(renderer, _shifted(shift)) for shift in (np.zeros(3), SHIFT))
    changed = differing(here, there, ALL_OUTPUTS)
    yield Finding("pixels that change at (5e5, 4.5e6, 300) m", changed, 0)


@case("B6", "scales whose products underflow", "1e-38 to 1e9 m")
def b6(renderer: Renderer) -> Found:
    means = [[-0.6, 0.1, 3], [0.0, -0.2, 3], [0.6, 0.3, 3], [0.2, 0.4, 2.5]]
    for scales in (1e-25, 1e-12, 1e-6, 1e4, 1e9):
        yield FrameSpec(splats(means, rotation((1, 2, 3), 50), scales, 0.6), camera(), outputs=ALL_OUTPUTS)
    mixed = [[1e-25, 0.1], [0.1, 1e-30], [1e9, 1e-9], [1e-38, 1e-38]]
    yield FrameSpec(splats(means, rotation((1, 2, 3), 50), mixed, 0.6), camera(), outputs=ALL_OUTPUTS)


@case("B7", "normals", "both sides of a splat")
def b7(renderer: Renderer) -> Found:
    for side in (-1.0, 1.0):
        cloud = random_splats(40, seed=9, depth=(-1.0, 1.0), scale=(0.05, 0.5), across=0.8)
        view = Camera.look_at(100, 80, 0.9, (0.3, -0.2, 4.0 * side), (0, 0, 0))
        yield FrameSpec(cloud, view, outputs=ALL_OUTPUTS)
    # the world-frame normal flips with the side
    cloud = splats([[0, 0, 0]], rotation((1, 0.5, 0.2), 35), 0.5)
    normals = []
    for side in (-1.0, 1.0):
        view = Camera.look_at(31, 31, 0.3, (0, 0, 3.0 * side), (0, 0, 0))
        normal = render(renderer, FrameSpec(cloud, view, outputs=("normal",)))["normal"][15, 15]
        towards = view.world_to_camera[:3, :3] @ (view.position / 3)
        yield Finding("normal pointing away from the camera", -float(normal @ towards), 0)
        normals.append(view.world_to_camera[:3, :3].T @ normal)
    yield Finding("sum of the normals of both sides", float(np.abs(sum(normals)).max()), 1e-6)


def _centered() -> SplatCloud:
    return splats([[0, 0, 2]], FACING, (0.3, 0.2), 0.9)


@case("B8", "pixel centres", "odd sizes, 1 x 1; principal point outside; 3 x 3 samples")
def b8(renderer: Renderer) -> Found:
    for width, height in ((1, 1), (7, 5), (33, 1), (101, 79)):
        yield FrameSpec(_centered(), camera(width, height, 30.0), outputs=ALL_OUTPUTS)
    off_center = camera(53, 31, 60.0, cx=-20.5, cy=44.25)
    yield FrameSpec(random_splats(80, seed=2), off_center, outputs=ALL_OUTPUTS)
    yield FrameSpec(random_splats(60, seed=13), camera(47, 33, 40.0), Quality(samples=3), ALL_OUTPUTS)
    # the image of a splat on the axis is symmetric and bit-identical at odd sizes
    frame = render(renderer, FrameSpec(_centered(), camera(101, 79, 30.0), outputs=("rgb", "depth")))
    for name, flip in (("left and right", np.s_[:, ::-1]), ("top and bottom", np.s_[::-1])):
        mirrored = {key: image[flip] for key, image in frame.items()}
        yield Finding(f"pixels that differ {name}", differing(frame, mirrored, frame.outputs), 0)
