"""Buffers between the stages of each backend against brute force."""

from itertools import pairwise

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, random_splats
from stage_buffers import CAMERA, CULLED, intermediates_of, listing

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.backends.view import View
from fidsplat.effects import select
from fidsplat.selftest.agreement import out_of_order


def footprint(cloud, view, index, dot=True):
    """Samples (rows, columns) whose ray meets splat `index` within its radius and beyond the near plane, or
    (`dot`) that lie in its low-pass dot: float64, by the definition (a 3 x 3 system for each ray, no
    homography)."""
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
    rays = np.stack(
        [(columns - view.center_x) / view.focal_x, (rows - view.center_y) / view.focal_y, np.ones_like(rows)],
        -1,
    )
    # center + tangents @ (u, v) = depth * ray
    system = np.concatenate([np.broadcast_to(tangents, (*rays.shape[:2], 3, 2)), -rays[..., None]], axis=-1)
    solution = np.linalg.solve(system, np.broadcast_to(-center[:, None], (*rays.shape, 1)))[..., 0]
    half_r2 = np.log(float(cloud.opacities[index])) - view.log_alpha_cutoff
    inside = (solution[..., :2] ** 2).sum(-1) <= 2 * half_r2 * (1 - 1e-6)
    inside &= solution[..., 2] >= view.near
    if dot and center[2] >= view.near:
        px, py = (
            view.focal_x * center[0] / center[2] + view.center_x,
            view.focal_y * center[1] / center[2] + view.center_y,
        )
        inside |= (columns - px) ** 2 + (rows - py) ** 2 <= half_r2 * (1 - 1e-6)
    return np.nonzero(inside)


@pytest.mark.parametrize("lists", ["sort_first", "bin_first"])
@pytest.mark.parametrize(("seed", "scale"), [(1, (1e-3, 2.0)), (7, (0.1, 50.0)), (3, (1e-5, 0.05))])
def test_lists_have_all_overlapped_tiles_and_few_others(backend, seed, scale, lists):
    """Cases A1, A3 to A5: no tile is missing for any pose; bounds in front of the camera are tight."""
    cloud = random_splats(120, seed, scale=scale)
    shape = listing(backend, lists)
    buffers, view = intermediates_of(backend, cloud, fs.Quality(alpha_cutoff=1 / 255), shape=shape)
    tiles_x = -(-view.width // shape.tile_width)
    listed = [set() for _ in range(len(cloud))]
    for tile in range(len(buffers["starts"]) - 1):
        for index in buffers["lists"][buffers["starts"][tile] : buffers["starts"][tile + 1]]:
            listed[index].add(tile)
    needed_in_front = listed_in_front = 0
    for index in range(len(cloud)):
        if cloud.opacities[index] <= 1 / 255:
            assert buffers["keys"][index] == CULLED
            continue
        rows, columns = footprint(cloud, view, index)
        needed = set((rows // shape.tile_height * tiles_x + columns // shape.tile_width).tolist())
        assert needed <= listed[index], f"splat {index} lacks tiles {sorted(needed - listed[index])}"
        reach = 3.4 * cloud.scales[index].max()
        if cloud.means[index][2] + 0.1 - reach > view.near:
            needed_in_front += len(needed)
            listed_in_front += len(listed[index])
    assert listed_in_front <= 1.05 * needed_in_front + 5


def test_bounds_contain_the_rims_of_huge_disks(backend):
    """Disks up to 10^8 samples wide with an edge in the image: bounds are padded by the float32 rounding of
    positions."""
    random = np.random.default_rng(8)
    radius, depth = 10 ** random.uniform(4, 6, 48), random.uniform(0.7, 1.5, 48)
    away = np.repeat([[1, 0], [-1, 0], [0, 1], [0, -1]], 12, axis=0) * radius[:, None]
    aside = random.uniform(-0.3, 0.3, (48, 2)) * depth[:, None]
    disks = fs.SplatCloud(
        np.column_stack([away + aside, depth]), [[1, 0, 0, 0]] * 48, np.column_stack([radius, radius]),
        np.ones(48), colors=np.ones((48, 3)),
    )  # fmt: skip
    quality = fs.Quality(alpha_cutoff=np.exp(-0.5), lowpass="none")
    features, view = prepare(disks, fs.Capture(CAMERA, ALL_OUTPUTS, quality))
    assert np.array_equal(view.rotation, np.eye(3))
    pipeline = backend.pipeline(features)
    boxes = backend.probe().bounding_boxes(
        pipeline, pipeline.render_intermediates(backend.upload(disks), view)
    )
    rows, columns = np.mgrid[0 : view.height, 0 : view.width] + 0.5
    for (x0, x1, y0, y1), mean, radius in zip(boxes, disks.means, disks.scales[:, 0], strict=True):
        x, y, z = mean.astype(float) + view.translation
        right = (columns - view.center_x) / view.focal_x * z - x
        down = (rows - view.center_y) / view.focal_y * z - y
        inside = np.nonzero(right**2 + down**2 <= float(radius) ** 2)
        assert 0 < len(inside[0]) < view.width * view.height
        assert x0 <= inside[1].min() <= inside[1].max() < x1
        assert y0 <= inside[0].min() <= inside[0].max() < y1


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
    buffers, view = intermediates_of(backend, doubled, fs.Quality())
    keys = buffers["keys"]
    visible = np.flatnonzero(keys != CULLED)
    order = visible[np.argsort(keys[visible], kind="stable")]
    depth = (means[visible].astype(float) @ view.rotation.T + view.translation)[:, 2]
    bits = keys[visible]
    decoded = np.where(bits & 0x80000000, bits & 0x7FFFFFFF, ~bits).view(np.float32)
    assert np.all(np.abs(decoded - depth) <= 2 * np.spacing(np.abs(depth).astype(np.float32)))
    assert out_of_order(buffers, order) == 0
    assert len(set(buffers["lists"])) > 0
    assert set(buffers["lists"]) <= set(visible)


def test_quaternions_are_normalised(backend):
    """Bit-identical for quaternions of twice the length."""
    cloud, longer = random_splats(100, seed=6), random_splats(100, seed=6)
    object.__setattr__(longer, "quats", 2 * longer.quats)
    batch_images = [intermediates_of(backend, each, fs.Quality())[0]["rgb"] for each in (cloud, longer)]
    assert np.array_equal(*batch_images)
    assert batch_images[0].any()


def test_culled_splats_change_nothing(backend):
    cloud = random_splats(400, seed=6)
    buffers, _ = intermediates_of(backend, cloud, fs.Quality())
    visible = np.flatnonzero(buffers["keys"] != CULLED)
    assert 0 < len(visible) < 400
    fewer = fs.SplatCloud(
        cloud.means[visible],
        cloud.quats[visible],
        cloud.scales[visible],
        cloud.opacities[visible],
        colors=cloud.colors[visible],
    )
    assert np.array_equal(intermediates_of(backend, fewer, fs.Quality())[0]["rgb"], buffers["rgb"])


@pytest.mark.parametrize("lists", ["sort_first", "bin_first"])
def test_splats_between_the_samples_are_culled(backend, lists):
    """Without a low-pass a splat smaller than a sample mostly intersects no ray and is not listed."""
    cloud = random_splats(20000, seed=3, scale=(1e-5, 3e-4))
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS, fs.Quality(lowpass="none")))
    pipeline = backend.pipeline(features, listing(backend, lists))
    buffers = pipeline.render_intermediates(backend.upload(cloud), view)
    visible = buffers["keys"] != CULLED
    x0, x1, y0, y1 = backend.probe().bounding_boxes(pipeline, buffers)[visible].T
    assert 5 < visible.sum() < 1000
    assert (x0 < x1).all()
    assert (y0 < y1).all()
    assert buffers["rgb"].any()


def test_tile_sizes_are_bit_identical(backend):
    """Cases A4 and A5: detects errors of the bounds."""
    cloud = random_splats(300, seed=3)
    quality = fs.Quality()
    base, _ = intermediates_of(backend, cloud, quality)
    for size, other in backend.configs("tiles").items():
        buffers, _ = intermediates_of(backend, cloud, quality, shape=other)
        for name in ALL_OUTPUTS:
            assert np.array_equal(buffers[name], base[name]), f"{name} differs with {size}"


@pytest.mark.parametrize("lowpass", ["screen", "none"])
def test_the_box_of_a_record_contains_all_fragments(backend, lowpass):
    """GPU blocks skip splats by this box."""
    quality = fs.Quality(lowpass=lowpass)
    cloud = random_splats(200, seed=5, scale=(1e-3, 5.0))
    features = select(cloud, fs.Capture(outputs=ALL_OUTPUTS, quality=quality))
    view = View.of(fs.Capture(CAMERA, quality=quality), cloud.origin)
    pipeline = backend.pipeline(features)
    buffers = pipeline.render_intermediates(backend.upload(cloud), view)
    boxes = backend.probe().bounding_boxes(pipeline, buffers)
    fragments = 0
    for index in np.flatnonzero(buffers["keys"] != CULLED):
        rows, columns = footprint(cloud, view, index, dot=lowpass == "screen")
        for axis, places in enumerate((columns, rows)):
            first, end = boxes[index, 2 * axis : 2 * axis + 2]
            assert np.all((places >= first) & (places < end)), index
        fragments += len(rows)
    assert fragments > 1000


def test_the_bounds_of_a_box_are_its_corners(backend):
    """Padded by half a sample for the antialiased edge."""
    box = fs.SplatCloud([(0.2, 0.1, 3)], [(1, 0, 0, 0)], [(0.3, 0.2)], [1.0], colors=[(1, 1, 1)]).with_boxes()
    features, view = prepare(box, fs.Capture(CAMERA, ALL_OUTPUTS))
    pipeline = backend.pipeline(features)
    bounds = backend.probe().bounding_boxes(
        pipeline, pipeline.render_intermediates(backend.upload(box), view)
    )[0]
    low, high = (view.rotation @ (x, y, 3) + view.translation for x, y in ((-0.1, -0.1), (0.5, 0.3)))
    expected = [
        *(view.focal_x * corner[0] / corner[2] + view.center_x for corner in (low, high)),
        *(view.focal_y * corner[1] / corner[2] + view.center_y for corner in (low, high)),
    ]
    assert np.abs(bounds - expected).max() <= 1.5


def test_layers_do_not_depend_on_tile_size_or_schedule(backend, renderer):
    """Four intersecting coplanar groups, and ungrouped splats."""
    planes = np.random.default_rng(9).choice([-1, -1, -1, 0, 1, 2, 3], 300)
    cloud = random_splats(300, seed=9, scale=(0.05, 0.5)).with_coplanar_groups(planes)
    base, _ = intermediates_of(backend, cloud, fs.Quality())
    other, _ = intermediates_of(backend, cloud, fs.Quality(), shape=backend.configs("schedule")["groups"])
    for name in ("rgb", "alpha", "normal", "depth"):
        assert np.abs(other[name] - base[name]).max() < 2e-5, name
    *_, (size, shape) = backend.configs("tiles").items()
    tiled, _ = intermediates_of(backend, cloud, fs.Quality(), shape=shape)
    for name in ALL_OUTPUTS:
        assert np.array_equal(tiled[name], base[name]), f"{name} differs with {size}"


@pytest.mark.parametrize("order", ["auto", "pixel"])
def test_splats_of_coplanar_groups_are_first_in_each_list(backend, order):
    """Group after group, whatever is between their centres."""
    generator = np.random.default_rng(2)
    cloud = random_splats(200, seed=2, depth=(2.0, 4.0)).with_coplanar_groups(generator.integers(-1, 3, 200))
    buffers, _ = intermediates_of(backend, cloud, fs.Quality(order=order))
    for start, end in pairwise(buffers["starts"]):
        groups = cloud.coplanar_groups[buffers["lists"][start:end]]
        assert (np.diff(np.where(groups < 0, 3, groups)) >= 0).all()


def test_schedules_agree(backend, renderer):
    cloud = random_splats(300, seed=9)
    base, _ = intermediates_of(backend, cloud, fs.Quality())
    other, _ = intermediates_of(backend, cloud, fs.Quality(), shape=backend.configs("schedule")["groups"])
    for name in ("rgb", "alpha", "normal", "depth"):
        assert np.allclose(other[name], base[name], rtol=1e-5, atol=2e-6), name
    assert np.array_equal(other["label"], base["label"])
