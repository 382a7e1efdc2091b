"""What passes between the stages of each backend that has them, against brute force."""

from dataclasses import replace

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, random_splats

import fidsplat as fs
from fidsplat.backends.base import View
from fidsplat.backends.planes import PlaneTable
from fidsplat.effects import select
from fidsplat.hard_cases.invariance import has_tiles, odd_shapes, other_schedule

CULLED = np.uint32(0xFFFFFFFF)
CAMERA = fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))


@pytest.fixture(scope="module")
def backend(renderer):
    if not has_tiles(renderer):
        pytest.skip("draws in one piece")
    return renderer.backend


def traced(backend, cloud, quality, outputs=("rgb",), shape=None):
    features = select(cloud, outputs, quality)
    view = View.of(CAMERA, quality, cloud.origin, (0, 0, 0))
    return backend.pipeline(features, shape).trace(backend.upload(cloud), view), view


def footprint(cloud, view, index):
    """Samples (rows, columns) whose ray meets splat `index` within its radius and beyond the near plane, or
    that lie in its low-pass dot: float64, by the definition (a 3 x 3 system for each ray, no homography)."""
    w, x, y, z = cloud.quats[index].astype(float) / np.linalg.norm(cloud.quats[index].astype(float))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    tangents = view.rotation @ rotation[:, :2] * cloud.scales[index].astype(float)
    center = view.rotation @ cloud.means[index].astype(float) + view.translation
    rows, columns = np.mgrid[0 : view.height, 0 : view.width] + 0.5
    rays = np.stack([(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], -1)
    # center + tangents @ (u, v) = depth * ray
    system = np.concatenate([np.broadcast_to(tangents, (*rays.shape[:2], 3, 2)), -rays[..., None]], axis=-1)
    solution = np.linalg.solve(system, np.broadcast_to(-center[:, None], (*rays.shape, 1)))[..., 0]
    half_r2 = np.log(float(cloud.opacities[index])) - view.log_cut
    inside = (solution[..., :2] ** 2).sum(-1) <= 2 * half_r2 * (1 - 1e-6)
    inside &= solution[..., 2] >= view.near
    if center[2] >= view.near:
        px, py = view.fx * center[0] / center[2] + view.cx, view.fy * center[1] / center[2] + view.cy
        inside |= (columns - px) ** 2 + (rows - py) ** 2 <= half_r2 * (1 - 1e-6)
    return np.nonzero(inside)


@pytest.mark.parametrize(("seed", "scale"), [(1, (1e-3, 2.0)), (7, (0.1, 50.0)), (3, (1e-5, 0.05))])
def test_every_touched_tile_has_the_splat_and_few_others_do(backend, seed, scale):
    """numerics A1, A3 to A5: nothing is lost, wherever the disk lies; bounds in front are tight."""
    cloud = random_splats(120, seed, scale=scale)
    trace, view = traced(backend, cloud, fs.Quality())
    shape = backend.shape
    tiles_x = -(-view.width // shape.tile_width)
    listed = [set() for _ in range(len(cloud))]
    for tile in range(len(trace["starts"]) - 1):
        for index in trace["lists"][trace["starts"][tile] : trace["starts"][tile + 1]]:
            listed[index].add(tile)
    needed_in_front = listed_in_front = 0
    for index in range(len(cloud)):
        if cloud.opacities[index] <= 1 / 255:
            assert trace["keys"][index] == CULLED
            continue
        rows, columns = footprint(cloud, view, index)
        needed = set((rows // shape.tile_height * tiles_x + columns // shape.tile_width).tolist())
        assert needed <= listed[index], f"splat {index} lacks tiles {sorted(needed - listed[index])}"
        reach = 3.4 * cloud.scales[index].max()
        if cloud.means[index][2] + 0.1 - reach > view.near:
            needed_in_front += len(needed)
            listed_in_front += len(listed[index])
    assert listed_in_front <= 1.05 * needed_in_front + 5


def test_keys_are_depths_and_the_order_is_total(backend):
    cloud = random_splats(3000, seed=4)
    # exact ties: their order must be that of their indices
    means = np.concatenate([cloud.means, cloud.means])
    doubled = fs.SplatCloud(
        means,
        np.concatenate([cloud.quats] * 2),
        np.concatenate([cloud.scales] * 2),
        np.concatenate([cloud.opacities] * 2),
        colors=np.concatenate([cloud.colors] * 2),
    )
    trace, view = traced(backend, doubled, fs.Quality())
    keys, order = trace["keys"], trace["order"]
    visible = np.flatnonzero(keys != CULLED)
    assert np.array_equal(np.sort(order), visible)
    assert np.array_equal(order, visible[np.argsort(keys[visible], kind="stable")])
    depth = (means[visible].astype(float) @ view.rotation.T + view.translation)[:, 2]
    bits = keys[visible]
    decoded = np.where(bits & 0x80000000, bits & 0x7FFFFFFF, ~bits).view(np.float32)
    assert np.all(np.abs(decoded - depth) <= 2 * np.spacing(np.abs(depth).astype(np.float32)))
    # a tile's list follows the order
    rank = np.full(len(doubled), -1)
    rank[order] = np.arange(len(order))
    for tile in range(len(trace["starts"]) - 1):
        inside = rank[trace["lists"][trace["starts"][tile] : trace["starts"][tile + 1]]]
        assert np.all(np.diff(inside) > 0)


def test_culled_splats_change_nothing(backend):
    cloud = random_splats(400, seed=6)
    trace, _ = traced(backend, cloud, fs.Quality())
    kept = np.flatnonzero(trace["keys"] != CULLED)
    assert 0 < len(kept) < 400
    fewer = fs.SplatCloud(
        cloud.means[kept],
        cloud.quats[kept],
        cloud.scales[kept],
        cloud.opacities[kept],
        colors=cloud.colors[kept],
    )
    assert np.array_equal(traced(backend, fewer, fs.Quality())[0]["rgb"], trace["rgb"])


def test_tile_size_leaves_every_bit_as_it_was(backend, renderer):
    """numerics A4 and A5: one test that finds every bug of the bounds."""
    cloud = random_splats(300, seed=3)
    quality = fs.Quality()
    shape = backend.shape
    base, _ = traced(backend, cloud, quality, ALL_OUTPUTS)
    if shape.schedule == "lanes":
        shapes = [replace(shape, tile_height=height) for height in (4, 8, 32)]
        # a scalar exp may round otherwise than a vector one, so vectors are compared with vectors
        shapes += [replace(shape, lanes=lanes, tile_width=lanes) for lanes in (4, 8) if lanes != shape.lanes]
    else:
        shapes = [replace(shape, tile_width=side, tile_height=side) for side in (8, 32)]
    shapes += odd_shapes(renderer)[1:]
    for other in shapes:
        trace, _ = traced(backend, cloud, quality, ALL_OUTPUTS, other)
        for name in ALL_OUTPUTS:
            assert np.array_equal(trace[name], base[name]), f"{name} differs with {other}"


def test_layers_are_the_same_in_every_tile_size_and_schedule(backend, renderer):
    """Four planes whose layers wait for one another, and splats of none."""
    planes = np.random.default_rng(9).choice([-1, -1, -1, 0, 1, 2, 3], 300)
    cloud = random_splats(300, seed=9, scale=(0.05, 0.5)).with_planes(planes)
    base, _ = traced(backend, cloud, fs.Quality(), ALL_OUTPUTS)
    other, _ = traced(backend, cloud, fs.Quality(), ALL_OUTPUTS, other_schedule(renderer))
    for name in ("rgb", "alpha", "normal", "depth"):
        assert np.abs(other[name] - base[name]).max() < 2e-5, name
    width = backend.shape.tile_width if backend.shape.schedule == "lanes" else 32
    again, _ = traced(
        backend, cloud, fs.Quality(), ALL_OUTPUTS, replace(backend.shape, tile_width=width, tile_height=32)
    )
    for name in ALL_OUTPUTS:
        assert np.array_equal(again[name], base[name]), name


def test_splats_of_a_plane_share_its_key(backend):
    """They arrive together, whatever lies between their centres."""
    generator = np.random.default_rng(2)
    cloud = random_splats(200, seed=2, depth=(2.0, 4.0)).with_planes(generator.integers(-1, 3, 200))
    trace, view = traced(backend, cloud, fs.Quality())
    for plane, key in enumerate(PlaneTable(cloud).keys(view)):
        keys = trace["keys"][cloud.planes == plane]
        bits = np.array([key]).view(np.uint32)
        wanted = ~bits if bits[0] & 0x80000000 else bits | 0x80000000
        assert (keys[keys != CULLED] == wanted).all()
        places = np.flatnonzero(cloud.planes[trace["order"]] == plane)
        assert len(places) == np.ptp(places) + 1


def test_both_schedules_draw_the_same_picture(backend, renderer):
    cloud = random_splats(300, seed=9)
    base, _ = traced(backend, cloud, fs.Quality(), ALL_OUTPUTS)
    other, _ = traced(backend, cloud, fs.Quality(), ALL_OUTPUTS, other_schedule(renderer))
    for name in ("rgb", "alpha", "normal", "depth"):
        assert np.allclose(other[name], base[name], rtol=1e-5, atol=2e-6), name
    assert np.array_equal(other["label"], base["label"])


@pytest.mark.parametrize("budget", [1, 50, 1000])
def test_a_small_pair_budget_gives_the_same_bits(backend, monkeypatch, budget):
    """numerics E3: a picture with more pairs than fit is drawn in bands of tiles."""
    cloud = random_splats(300, seed=12)
    features = select(cloud, ALL_OUTPUTS, fs.Quality())
    view = View.of(CAMERA, fs.Quality(), cloud.origin, (0, 0, 0))
    pipeline, resident = backend.pipeline(features), backend.upload(cloud)
    whole = pipeline.render(resident, view)
    assert whole.stats["pairs"] > 1000
    monkeypatch.setattr(backend, "pair_budget", budget)
    banded = pipeline.render(resident, view)
    assert banded.stats == whole.stats
    for name in ALL_OUTPUTS:
        assert np.array_equal(banded.read(name), whole.read(name)), name
