"""C: the order of splats: ties, keys, and what must not depend on order at all."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fidsplat.backends.base import View
from fidsplat.cameras import Camera
from fidsplat.hard_cases.agreement import ALL_OUTPUTS, COLOR_TOLERANCE, Picture
from fidsplat.hard_cases.case import Case, Finding
from fidsplat.hard_cases.clouds import camera, random_splats, splats, taken, turned
from fidsplat.hard_cases.coplanar import largest_jump, tag, turning
from fidsplat.hard_cases.invariance import (
    CULLED,
    differing,
    draw,
    has_tiles,
    out_of_order,
    tile_shapes,
    trace,
)
from fidsplat.quality import Quality
from fidsplat.render import Renderer
from fidsplat.rotations import quaternion_to_matrix
from fidsplat.splats import SplatCloud


def fronto_parallel(away: float, count: int = 200) -> Picture:
    """Splats at depth 5 facing a camera that is turned, `away` metres from the origin: many tie."""
    generator = np.random.default_rng(int(away) + 1)
    turn = generator.normal(size=4)
    turn /= np.linalg.norm(turn)
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(turn)
    pose[:3, 3] = -pose[:3, :3] @ np.array([0.6, -0.64, 0.48]) * away
    means = np.column_stack([generator.uniform(-2, 2, (count, 2)), np.full(count, 5.0)]) - pose[:3, 3]
    facing = turn * [1, -1, -1, -1]
    grey = np.repeat(generator.integers(0, 2, (count, 1)), 3, axis=1)
    world = (means @ pose[:3, :3]).astype(np.float32)
    return Picture(splats(world, facing, 0.25, 0.9, grey), camera(world_to_camera=pose), outputs=ALL_OUTPUTS)


def _tilted_planes(quality: Quality) -> Picture:
    """Two tags that cross, and splats of no plane between."""
    others = random_splats(30, seed=10, depth=(-0.6, 0.6), scale=(0.02, 0.2), across=0.6)
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(turned((0.2, 1, 0), 50))
    cloud = SplatCloud.concatenate([tag(6), tag(6, seed=1).transformed(pose), others])
    view = Camera.look_at(100, 80, 0.8, (0.9, -0.4, -1.4), (0, 0, 0))
    return Picture(cloud, view, quality, ALL_OUTPUTS)


def _c1() -> Iterator[Picture]:
    for away in (0.0, 1.0, 1000.0):
        yield fronto_parallel(away)
    yield _tilted_planes(Quality())
    yield _tilted_planes(Quality(coplanar="order"))


def _c1_order(renderer: Renderer) -> Iterator[Finding]:
    wrong_keys = wrong_order = 0
    for away in (0.0, 1.0, 1000.0):
        picture = fronto_parallel(away)
        keys, unsorted = _keys_and_order(renderer, picture)
        wrong_keys += keys
        wrong_order += unsorted
    yield Finding("keys beyond 2 ulp of their depth", wrong_keys, 0)
    yield Finding("splats out of the order by key and index", wrong_order, 0)

    cloud = tag()
    views = list(turning(cloud, "blend", steps=2))
    yield Finding("jump of a tag in steps of 1e-4 deg", largest_jump(renderer, iter(views))[0], 2e-3)
    shuffled = taken(cloud, np.random.default_rng(3).permutation(len(cloud)))
    again = Picture(shuffled, views[0].camera, views[0].quality, ("rgb",))
    change = np.abs(draw(renderer, again)["rgb"] - draw(renderer, views[0])["rgb"]).max()
    yield Finding("change when a tag's splats are re-ordered", float(change), COLOR_TOLERANCE)


def _keys_and_order(renderer: Renderer, picture: Picture) -> tuple[int, int]:
    """How many keys are not their splat's depth to 2 ulp, and how many splats stand where they should not."""
    planes = trace(renderer, picture)
    view = View.of(picture.camera, picture.quality, picture.cloud.origin, picture.background)
    depth = (picture.cloud.means.astype(float) @ view.rotation.T + view.translation)[:, 2]
    keys = planes["keys"]
    if keys.dtype == np.uint32:
        visible = np.flatnonzero(keys != CULLED)
        bits = keys[visible]
        decoded = np.where(bits & 0x80000000, bits & 0x7FFFFFFF, ~bits).view(np.float32)
    else:  # the reference keeps depths
        visible = np.sort(planes["order"])
        decoded = keys[visible]
    off = np.abs(decoded - depth[visible]) > 2 * np.spacing(np.abs(depth[visible]).astype(np.float32))
    wanted = visible[np.argsort(decoded, kind="stable")]
    return int(off.sum()), out_of_order(planes, wanted)


def _depths(values) -> Picture:
    """Splats that cover the middle at these depths, in shuffled order; half of them show."""
    generator = np.random.default_rng(11)
    depths = generator.permutation(np.asarray(values, np.float32))
    means = np.column_stack([np.zeros((len(depths), 2)), depths])
    # wide enough to reach the camera from behind
    quats = generator.normal(size=(len(depths), 4))
    scales = np.maximum(np.abs(depths), 0.3)[:, None]
    colors = generator.random((len(depths), 3))
    return Picture(splats(means, quats, scales, 0.5, colors), camera(), outputs=ALL_OUTPUTS)


def _key_pictures() -> Iterator[Picture]:
    ulp = np.float32(5) + np.arange(12, dtype=np.float32) * np.spacing(np.float32(5))
    yield _depths(ulp)  # neighbours of float32
    yield _depths([-2.0, -1.0, -0.5, -1e-3, -0.0, 0.0, 1e-3, 0.5, 1.0])  # centres behind the camera
    yield _depths([*np.linspace(1, 2, 10), 1e6, 1e12])  # far outliers
    yield _depths([*np.geomspace(0.02, 1e6, 40)])


def _c2_order(renderer: Renderer) -> Iterator[Finding]:
    found = [_keys_and_order(renderer, picture) for picture in _key_pictures()]
    yield Finding("keys beyond 2 ulp of their depth", sum(pair[0] for pair in found), 0)
    yield Finding("splats out of the order by depth and index", sum(pair[1] for pair in found), 0)
    keys = trace(renderer, next(_key_pictures()))["keys"]
    yield Finding("neighbouring depths with one key", len(keys) - len(np.unique(keys)), 0)


def _c3(renderer: Renderer) -> Iterator[Finding]:
    picture = Picture(random_splats(300, seed=12), camera(), outputs=ALL_OUTPUTS)
    first = draw(renderer, picture)
    kept = {name: first[name].copy() for name in first}
    changed = max(differing(kept, draw(renderer, picture), ALL_OUTPUTS) for _ in range(3))
    yield Finding("pixels that change when drawn again", changed, 0)
    if has_tiles(renderer):
        changed = differing(kept, trace(renderer, picture, tile_shapes(renderer)[0]), ALL_OUTPUTS)
        yield Finding("pixels that change in other tiles", changed, 0)
    plain = Picture(taken(picture.cloud, np.arange(300)), picture.camera, outputs=("rgb",))
    yield Finding(
        "pixels that change without other outputs", differing(kept, draw(renderer, plain), ("rgb",)), 0
    )


CASES = (
    Case(
        "C1", "coplanar splats and ties", "200 at depth 5, 0 to 1000 m from the origin; tags", _c1, _c1_order
    ),
    Case("C2", "precision and sign of keys", "depths 1 ulp apart, below 0, 1e12 m", _key_pictures, _c2_order),
    Case("C3", "the same bits every time", "300 splats, again and in other tiles", None, _c3),
)
