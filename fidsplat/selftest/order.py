"""Self-test group C: depth order, ties, sort keys, and invariance under reordering."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from fidsplat.backends.prepare import view_of
from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest.agreement import (
    ALL_OUTPUTS,
    COLOR_TOLERANCE,
    CULLED,
    FrameSpec,
    differing,
    out_of_order,
    render,
    render_intermediates,
)
from fidsplat.selftest.case import Finding, Found, case
from fidsplat.selftest.clouds import camera, quaternion, rotation, splats, subset_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import quaternion_to_matrix

STEP = math.radians(1e-4)
WALL_STEP = math.radians(1e-3)
"""camera steps in radians per frame; larger for a wall, whose splats change order less often"""
SMOOTH = 1e-3
"""largest change of a pixel that moving edges cause in a step of 1e-4 degrees; larger changes are order
flips"""
ON_TAGS = Camera.look_at(96, 80, 0.8, (0.05, -0.03, -1.6), (0, 0, 0))
SIDES = ("before", "behind", "through")


def tag(side: int = 8, seed: int = 0) -> SplatCloud:
    """A marker-like coplanar group at z = 0, 1 m wide: black and white modules with overlapping splats."""
    generator = np.random.default_rng(seed)
    bits = generator.integers(0, 2, (side, side))
    bits[[0, -1]] = bits[:, [0, -1]] = 0
    rows, columns = (grid.ravel() for grid in np.mgrid[0:side, 0:side])
    means = np.column_stack([(columns + 0.5) / side - 0.5, (rows + 0.5) / side - 0.5, np.zeros(side**2)])
    grey = np.repeat(bits.ravel()[:, None], 3, axis=1)
    return splats(means, (1, 0, 0, 0), 0.45 / side, 0.9, grey).with_coplanar_groups(0)


def wall(count: int = 2000, away: float = 0.05, seed: int = 1) -> SplatCloud:
    """Ungrouped grey splats of opacity 0.9 that cover 3 x 3 m from z = `away` to 2 cm behind it."""
    generator = np.random.default_rng(seed)
    depth = generator.uniform(away, away + 0.02, count)
    means = np.column_stack([generator.uniform(-1.5, 1.5, (count, 2)), depth])
    scales = generator.uniform(0.5, 1.5, (count, 2)) * 2.7 / math.sqrt(count)
    grey = np.repeat(generator.uniform(0, 1, (count, 1)), 3, axis=1)
    return splats(means.astype(np.float32), (1, 0, 0, 0), scales, 0.9, grey)


def camera_path(
    cloud: SplatCloud,
    order: str,
    steps: int = 8,
    tilt: float = 0.0,
    width: int = 96,
    height: int = 80,
    step: float = STEP,
) -> Iterator[FrameSpec]:
    """Frames of a tag 1 m wide from 1.6 m, with a camera that orbits it in steps of `step` radians.

    The camera moves sideways and up at once, and is level with the centre of the tag halfway. tilt: degrees
    about the vertical axis halfway; 0 is fronto-parallel.
    """
    quality = Quality(order=order)
    for number in range(-steps, steps + 1):
        rise = (number + 0.5) * step
        azimuth, level = math.radians(tilt) + rise, 1.6 * math.cos(rise)
        position = -level * math.sin(azimuth), -1.6 * math.sin(rise), -level * math.cos(azimuth)
        camera = Camera.look_at(width, height, 0.8, position, (0, 0, 0))
        yield FrameSpec(cloud, camera, quality, ("rgb",))


def tag_and_large_splat(where: str) -> tuple[SplatCloud, SplatCloud]:
    """A tag, and a large slanted splat in front of it (`before`), `behind` it or intersecting it (`through`).

    `before` and `behind`: the centre of the splat is on the other side of the tag's plane, so that sorting by
    centres is wrong.
    """
    middle, slide = {"before": (-0.75, -1.3), "behind": (0.75, 1.3), "through": (0.0, 0.7)}[where]
    along = np.array([math.cos(math.radians(50)), 0, -math.sin(math.radians(50))])
    center = np.array([0, 0, middle]) + slide * along
    big = splats([center], quaternion(along, (0, 1, 0)), 0.9, 0.8, (0.9, 0.5, 0.2))
    return tag(6), big


def composited_parts(
    renderer: Renderer, parts: Sequence[SplatCloud], camera: Camera, order: str = "auto"
) -> tuple[np.ndarray, np.ndarray]:
    """Two images (h, w, 3) of several clouds, each a coplanar group or a single splat: rendered together, and
    composited per pixel by depth from an image of each cloud. Both are 0 where two depths agree to 1e-4.
    """
    # with a cut-off above 1/255 every rendered pixel has a depth
    quality = Quality(alpha_cutoff=1 / 250, transmittance_stop=0.0, order=order)
    # all outputs, since kernels for them are compiled by other tests
    frames = [render(renderer, FrameSpec(part, camera, quality, ALL_OUTPUTS, (0, 0, 0))) for part in parts]
    together = FrameSpec(SplatCloud.concatenate(parts), camera, quality, ALL_OUTPUTS, (0, 0, 0))
    rgb, alpha, depth = (np.stack([frame[name] for frame in frames]) for name in ("rgb", "alpha", "depth"))
    ranks = np.argsort(np.where(alpha > 0, depth, np.inf), axis=0)
    light, expected = np.ones(alpha.shape[1:]), np.zeros(rgb.shape[1:])
    for k in ranks:
        index = k[None]
        expected += light[..., None] * np.take_along_axis(rgb, index[..., None], 0)[0]
        light *= 1 - np.take_along_axis(alpha, index, 0)[0]
    ranked = np.sort(np.where(alpha > 0, depth, np.inf), axis=0)
    with np.errstate(invalid="ignore"):
        clear = 1.0 - np.any(np.diff(ranked, axis=0) < 1e-4, axis=0)[..., None]
    return render(renderer, together)["rgb"] * clear, expected * clear


def faint_between(opacity: float) -> FrameSpec:
    """A black and a white splat of a group tilted by 40 degrees, and a faint ungrouped splat whose centre is
    between theirs in depth.
    """
    rotated = rotation((0, 1, 0), 40)
    along = quaternion_to_matrix(rotated)[:, 0]
    means = [(0, 0, 2) - 0.1 * along, (0, 0, 2) + 0.1 * along, (0, 0, 2)]
    colors = [(0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5)]
    cloud = splats(means, rotated, 0.15, [0.9, 0.9, opacity], colors).with_coplanar_groups([0, 0, -1])
    return FrameSpec(cloud, Camera.pinhole(33, 33, 60.0, 60.0, 16.5, 16.5), outputs=("rgb",))


def largest_jump(renderer: Renderer, specs: Iterator[FrameSpec]) -> tuple[float, np.ndarray, np.ndarray]:
    """Largest change of a pixel between successive frames, and the two images (h, w, 3)."""
    worst = -1.0, np.zeros(0), np.zeros(0)
    last = None
    for spec in specs:
        rgb = render(renderer, spec)["rgb"]
        if last is not None and (jump := float(np.abs(rgb - last).max())) > worst[0]:
            worst = jump, last, rgb
        last = rgb
    return worst


def fronto_parallel(away: float, count: int = 200) -> FrameSpec:
    """Splats at depth 5 that face a rotated camera, `away` metres from the origin: many depths tie."""
    generator = np.random.default_rng(int(away) + 1)
    about_z = generator.normal(size=4)
    about_z /= np.linalg.norm(about_z)
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(about_z)
    pose[:3, 3] = -pose[:3, :3] @ np.array([0.6, -0.64, 0.48]) * away
    means = np.column_stack([generator.uniform(-2, 2, (count, 2)), np.full(count, 5.0)]) - pose[:3, 3]
    facing = about_z * [1, -1, -1, -1]
    grey = np.repeat(generator.integers(0, 2, (count, 1)), 3, axis=1)
    world = (means @ pose[:3, :3]).astype(np.float32)
    return FrameSpec(
        splats(world, facing, 0.25, 0.9, grey), camera(world_to_camera=pose), outputs=ALL_OUTPUTS
    )


def crossing_tags() -> list[SplatCloud]:
    """Two intersecting tilted tags."""
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(rotation((0.2, 1, 0), 50))
    return [tag(6), tag(6, seed=1).transformed(pose)]


def _tilted_planes(quality: Quality) -> FrameSpec:
    """Two intersecting tags, and ungrouped splats between them."""
    others = random_splats(30, seed=10, depth=(-0.6, 0.6), scale=(0.02, 0.2), across=0.6)
    cloud = SplatCloud.concatenate([*crossing_tags(), others])
    view = Camera.look_at(100, 80, 0.8, (0.9, -0.4, -1.4), (0, 0, 0))
    return FrameSpec(cloud, view, quality, ALL_OUTPUTS)


def _three_tags(quality: Quality) -> FrameSpec:
    """Three intersecting tags, and ungrouped splats between them."""
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(rotation((1, 0.3, 0), -35))
    pose[2, 3] = 0.1
    others = random_splats(30, seed=13, depth=(-0.6, 0.6), scale=(0.02, 0.2), across=0.6)
    cloud = SplatCloud.concatenate([*crossing_tags(), others, tag(6, seed=2).transformed(pose)])
    return FrameSpec(cloud, ON_TAGS, quality, ALL_OUTPUTS)


def tag_before_wall(count: int) -> SplatCloud:
    """A tag 5 cm in front of a wall of ungrouped splats."""
    return SplatCloud.concatenate([tag(), wall(count)])


def _shuffled(cloud: SplatCloud) -> SplatCloud:
    return subset_of(cloud, np.random.default_rng(3).permutation(len(cloud)))


def _c1_order(renderer: Renderer) -> Iterator[Finding]:
    wrong_keys = wrong_order = 0
    for distance in (0.0, 1.0, 1000.0):
        spec = fronto_parallel(distance)
        keys, unsorted = _keys_and_order(renderer, spec)
        wrong_keys += keys
        wrong_order += unsorted
    yield Finding("keys beyond 2 ulp of their depth", wrong_keys, 0)
    yield Finding("splats that violate the order by key and index", wrong_order, 0)

    cloud = tag()
    yield Finding(
        "jump of a tag in steps of 1e-4 deg", largest_jump(renderer, camera_path(cloud, "auto", 2))[0], SMOOTH
    )
    tilted = next(camera_path(tag_before_wall(150), "pixel", 0, 30))
    for what, spec in (
        ("a tag's splats", next(camera_path(cloud, "auto", 0))),
        ("a tag's splats among others", tilted),
    ):
        shuffled = FrameSpec(_shuffled(spec.cloud), spec.camera, spec.quality, ("rgb",))
        change = np.abs(render(renderer, shuffled)["rgb"] - render(renderer, spec)["rgb"]).max()
        yield Finding(f"change when {what} are reordered", float(change), COLOR_TOLERANCE)


def _c1_layers(renderer: Renderer) -> Iterator[Finding]:
    for tilt in (0.0, 30.0, 60.0):
        jump = largest_jump(renderer, camera_path(tag_before_wall(150), "pixel", 2, tilt))[0]
        yield Finding(f"jump of a tag in front of a wall, {tilt:g} deg", jump, SMOOTH)
    # opacity just above and just below the cut-off
    with_it, without = (render(renderer, faint_between(n / 255))["rgb"] for n in (1.01, 0.99))
    change = float(np.abs(with_it - without).max())
    yield Finding("change by a faint splat in between", change, 1.01 / 255)
    for title, parts in (
        *((f"tag with a large splat {side} it", tag_and_large_splat(side)) for side in SIDES),
        ("intersecting tags", crossing_tags()),
    ):
        got, expected = composited_parts(renderer, parts, ON_TAGS)
        yield Finding(
            f"{title}: difference from compositing images of the parts",
            float(np.abs(got - expected).max()),
            COLOR_TOLERANCE,
        )


@case("C1", "coplanar splats and depth ties", "200 splats at depth 5, 0 to 1000 m from the origin; tags")
def c1(renderer: Renderer) -> Found:
    for distance in (0.0, 1.0, 1000.0):
        yield fronto_parallel(distance)
    yield _tilted_planes(Quality())
    yield _tilted_planes(Quality(order="centre"))
    yield _three_tags(Quality())
    for side in SIDES:
        cloud = SplatCloud.concatenate(tag_and_large_splat(side))
        yield FrameSpec(cloud, ON_TAGS, outputs=ALL_OUTPUTS)
    at_wall = next(camera_path(tag_before_wall(150), "auto", 0, 30))
    yield FrameSpec(at_wall.cloud, at_wall.camera, outputs=ALL_OUTPUTS)
    yield from _c1_order(renderer)
    yield from _c1_layers(renderer)


def _keys_and_order(renderer: Renderer, spec: FrameSpec) -> tuple[int, int]:
    """Number of keys that differ from the depth by more than 2 ulp, and of splats out of order."""
    buffers = render_intermediates(renderer, spec)
    view = view_of(spec.capture, spec.cloud.origin)
    depth = (spec.cloud.means.astype(float) @ view.rotation.T + view.translation)[:, 2]
    keys = buffers["keys"]
    if keys.dtype == np.uint32:
        visible = np.flatnonzero(keys != CULLED)
        bits = keys[visible]
        decoded = np.where(bits & 0x80000000, bits & 0x7FFFFFFF, ~bits).view(np.float32)
    else:  # the reference backend has depths instead of sort keys
        visible = np.sort(buffers["order"])
        decoded = keys[visible]
    off = np.abs(decoded - depth[visible]) > 2 * np.spacing(np.abs(depth[visible]).astype(np.float32))
    expected = visible[np.argsort(decoded, kind="stable")]
    return int(off.sum()), out_of_order(buffers, expected)


def _depths(values) -> FrameSpec:
    """Splats of opacity 1/2 that cover the image centre at these depths, in shuffled order."""
    generator = np.random.default_rng(11)
    depths = generator.permutation(np.asarray(values, np.float32))
    means = np.column_stack([np.zeros((len(depths), 2)), depths])
    # wide enough to reach the camera plane from behind
    quats = generator.normal(size=(len(depths), 4))
    scales = np.maximum(np.abs(depths), 0.3)[:, None]
    colors = generator.random((len(depths), 3))
    return FrameSpec(splats(means, quats, scales, 0.5, colors), camera(), outputs=ALL_OUTPUTS)


def _key_specs() -> Iterator[FrameSpec]:
    ulp = np.float32(5) + np.arange(12, dtype=np.float32) * np.spacing(np.float32(5))
    yield _depths(ulp)  # neighbouring float32 numbers
    yield _depths([-2.0, -1.0, -0.5, -1e-3, -0.0, 0.0, 1e-3, 0.5, 1.0])  # centres behind the camera
    yield _depths([*np.linspace(1, 2, 10), 1e6, 1e12])  # far outliers
    yield _depths([*np.geomspace(0.02, 1e6, 40)])


@case("C2", "precision and sign of keys", "depths 1 ulp apart, below 0, 1e12 m")
def c2(renderer: Renderer) -> Found:
    yield from _key_specs()
    orders = [_keys_and_order(renderer, spec) for spec in _key_specs()]
    yield Finding("keys beyond 2 ulp of their depth", sum(pair[0] for pair in orders), 0)
    yield Finding("splats that violate the order by depth and index", sum(pair[1] for pair in orders), 0)
    keys = render_intermediates(renderer, next(_key_specs()))["keys"]
    yield Finding("neighbouring depths with one key", len(keys) - len(np.unique(keys)), 0)


@case("C3", "determinism", "300 splats, rendered again, with other tile sizes and outputs")
def c3(renderer: Renderer) -> Found:
    spec = FrameSpec(random_splats(300, seed=12), camera(), outputs=ALL_OUTPUTS)
    first = render(renderer, spec)
    copies = {name: first[name].copy() for name in first}
    changed = max(differing(copies, render(renderer, spec), ALL_OUTPUTS) for _ in range(3))
    yield Finding("pixels that change when rendered again", changed, 0)
    if renderer.backend.has("probe"):
        tiles = next(iter(renderer.backend.configs("tiles").values()))
        changed = differing(copies, render_intermediates(renderer, spec, tiles), ALL_OUTPUTS)
        yield Finding("pixels that change with another tile size", changed, 0)
    plain = FrameSpec(subset_of(spec.cloud, np.arange(300)), spec.camera, outputs=("rgb",))
    yield Finding(
        "pixels that change without other outputs", differing(copies, render(renderer, plain), ("rgb",)), 0
    )


def crossing(count: int = 120) -> SplatCloud:
    """Large intersecting splats."""
    return random_splats(count, seed=15, depth=(0.5, 4.0), scale=(0.2, 0.8))


def fan() -> SplatCloud:
    """40 splats 2 m wide that intersect in one line at 3 m, so that each is partly in front of every other
    one."""
    generator = np.random.default_rng(5)
    quats = np.array([rotation((0, 1, 0), angle) for angle in np.linspace(-75, 75, 40)])
    means = np.tile([0.0, 0.0, 3.0], (40, 1))
    return splats(means, quats, (0.35, 0.5), generator.uniform(0.1, 0.9, 40), generator.random((40, 3)))


def _pixel_specs() -> Iterator[FrameSpec]:
    by_pixel = Quality(order="pixel")
    yield FrameSpec(crossing(), camera(), by_pixel, ALL_OUTPUTS)
    yield FrameSpec(fan(), camera(), by_pixel, ALL_OUTPUTS)
    yield FrameSpec(crossing(60), Camera.fisheye(90, 70, math.radians(160)), by_pixel, ALL_OUTPUTS)
    yield _tilted_planes(by_pixel)
    yield _three_tags(by_pixel)
    through_fan = SplatCloud.concatenate([fan(), tag().transformed(_tag_pose())])
    for quality in (by_pixel, Quality()):
        yield FrameSpec(through_fan, camera(), quality, ALL_OUTPUTS)


def _tag_pose() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(rotation((0.3, 1, 0), 30))
    pose[2, 3] = 2.9
    return pose


@case("C4", "order by fragment depth", "intersecting splats and coplanar groups; a fan of 40 splats")
def c4(renderer: Renderer) -> Found:
    yield from _pixel_specs()
    # the intersection line of two splats may move across a few pixels
    _, before, after = largest_jump(renderer, camera_path(crossing(), "pixel", 2))
    jumped = float((np.abs(after - before).max(2) > SMOOTH).mean())
    yield Finding("fraction of pixels that jump at intersections in a step of 1e-4 deg", jumped, 1e-3)
    spec = FrameSpec(crossing(), camera(), Quality(order="pixel"), ("rgb",))
    shuffled = FrameSpec(_shuffled(spec.cloud), spec.camera, spec.quality, ("rgb",))
    change = np.abs(render(renderer, shuffled)["rgb"] - render(renderer, spec)["rgb"]).max()
    yield Finding("change when splats are shuffled", float(change), COLOR_TOLERANCE)
