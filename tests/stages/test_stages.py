"""What passes between the stages of each backend that has them, against brute force."""

from itertools import pairwise

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, random_splats

import fidsplat as fs
from fidsplat.backends.opencl.lists import GatheredLists
from fidsplat.backends.planes import PlaneTable
from fidsplat.backends.prepare import prepare, prepare_batch
from fidsplat.backends.probing import Reshapes
from fidsplat.backends.view import View
from fidsplat.effects import select
from fidsplat.hard_cases.agreement import out_of_order
from fidsplat.views import views_of

CULLED = np.uint32(0xFFFFFFFF)
CAMERA = fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))


@pytest.fixture(scope="module")
def backend(renderer):
    if not isinstance(renderer.backend, Reshapes):
        pytest.skip("draws in one piece")
    return renderer.backend


def traced(backend, cloud, quality, shape=None):
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS, quality))
    return backend.pipeline(features, shape).trace(backend.upload(cloud), view), view


def listing(backend, lists):
    """The shape with one of the two ways of listing."""
    shapes = backend.shapes("listing")
    if lists not in shapes:
        pytest.skip("lists in one way")
    return shapes[lists]


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
    half_r2 = np.log(float(cloud.opacities[index])) - view.log_cut
    inside = (solution[..., :2] ** 2).sum(-1) <= 2 * half_r2 * (1 - 1e-6)
    inside &= solution[..., 2] >= view.near
    if dot and center[2] >= view.near:
        px, py = (
            view.focal_x * center[0] / center[2] + view.center_x,
            view.focal_y * center[1] / center[2] + view.center_y,
        )
        inside |= (columns - px) ** 2 + (rows - py) ** 2 <= half_r2 * (1 - 1e-6)
    return np.nonzero(inside)


@pytest.mark.parametrize("lists", ["ordered", "tiled"])
@pytest.mark.parametrize(("seed", "scale"), [(1, (1e-3, 2.0)), (7, (0.1, 50.0)), (3, (1e-5, 0.05))])
def test_every_touched_tile_has_the_splat_and_few_others_do(backend, seed, scale, lists):
    """numerics A1, A3 to A5: nothing is lost, wherever the disk lies; bounds in front are tight."""
    cloud = random_splats(120, seed, scale=scale)
    shape = listing(backend, lists)
    trace, view = traced(backend, cloud, fs.Quality(alpha_cutoff=1 / 255), shape=shape)
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


def test_bounds_hold_the_rims_of_huge_disks(backend):
    """Disks up to 10^8 samples wide with an edge in the picture: what a float32 place may be off is room that
    bounds have."""
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
    boxes = backend.probe().boxes(pipeline, pipeline.trace(backend.upload(disks), view))
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
    trace, view = traced(backend, doubled, fs.Quality())
    keys = trace["keys"]
    visible = np.flatnonzero(keys != CULLED)
    order = visible[np.argsort(keys[visible], kind="stable")]
    depth = (means[visible].astype(float) @ view.rotation.T + view.translation)[:, 2]
    bits = keys[visible]
    decoded = np.where(bits & 0x80000000, bits & 0x7FFFFFFF, ~bits).view(np.float32)
    assert np.all(np.abs(decoded - depth) <= 2 * np.spacing(np.abs(depth).astype(np.float32)))
    assert out_of_order(trace, order) == 0
    assert len(set(trace["lists"])) > 0
    assert set(trace["lists"]) <= set(visible)


def test_quaternions_of_any_length_turn_a_splat(backend):
    """To the bit, where all are twice as long."""
    cloud, longer = random_splats(100, seed=6), random_splats(100, seed=6)
    object.__setattr__(longer, "quats", 2 * longer.quats)
    pictures = [traced(backend, each, fs.Quality())[0]["rgb"] for each in (cloud, longer)]
    assert np.array_equal(*pictures)
    assert pictures[0].any()


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


@pytest.mark.parametrize("lists", ["ordered", "tiled"])
def test_splats_between_the_samples_are_culled(backend, lists):
    """Without a low-pass a splat that is smaller than a sample mostly meets no ray; it costs no list."""
    cloud = random_splats(20000, seed=3, scale=(1e-5, 3e-4))
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS, fs.Quality(lowpass="none")))
    pipeline = backend.pipeline(features, listing(backend, lists))
    trace = pipeline.trace(backend.upload(cloud), view)
    kept = trace["keys"] != CULLED
    x0, x1, y0, y1 = backend.probe().boxes(pipeline, trace)[kept].T
    assert 5 < kept.sum() < 1000
    assert (x0 < x1).all()
    assert (y0 < y1).all()
    assert trace["rgb"].any()


def test_tile_size_leaves_every_bit_as_it_was(backend):
    """numerics A4 and A5: one test that finds every bug of the bounds."""
    cloud = random_splats(300, seed=3)
    quality = fs.Quality()
    base, _ = traced(backend, cloud, quality)
    for size, other in backend.shapes("tiles").items():
        trace, _ = traced(backend, cloud, quality, shape=other)
        for name in ALL_OUTPUTS:
            assert np.array_equal(trace[name], base[name]), f"{name} differs with {size}"


@pytest.mark.parametrize("lowpass", ["screen", "none"])
def test_the_box_of_a_record_holds_all_that_the_splat_touches(backend, lowpass):
    """What a block of a GPU passes over, it must not have needed."""
    quality = fs.Quality(lowpass=lowpass)
    cloud = random_splats(200, seed=5, scale=(1e-3, 5.0))
    features = select(cloud, fs.Capture(outputs=ALL_OUTPUTS, quality=quality))
    view = View.of(fs.Capture(CAMERA, quality=quality), cloud.origin)
    pipeline = backend.pipeline(features)
    trace = pipeline.trace(backend.upload(cloud), view)
    boxes = backend.probe().boxes(pipeline, trace)
    seen = 0
    for index in np.flatnonzero(trace["keys"] != CULLED):
        rows, columns = footprint(cloud, view, index, dot=lowpass == "screen")
        for axis, places in enumerate((columns, rows)):
            first, end = boxes[index, 2 * axis : 2 * axis + 2]
            assert np.all((places >= first) & (places < end)), index
        seen += len(rows)
    assert seen > 1000


def test_the_bounds_of_a_box_are_its_corners(backend):
    """And half a sample around them, where it fades."""
    box = fs.SplatCloud([(0.2, 0.1, 3)], [(1, 0, 0, 0)], [(0.3, 0.2)], [1.0], colors=[(1, 1, 1)]).with_boxes()
    features, view = prepare(box, fs.Capture(CAMERA, ALL_OUTPUTS))
    pipeline = backend.pipeline(features)
    bounds = backend.probe().boxes(pipeline, pipeline.trace(backend.upload(box), view))[0]
    low, high = (view.rotation @ (x, y, 3) + view.translation for x, y in ((-0.1, -0.1), (0.5, 0.3)))
    wanted = [
        *(view.focal_x * corner[0] / corner[2] + view.center_x for corner in (low, high)),
        *(view.focal_y * corner[1] / corner[2] + view.center_y for corner in (low, high)),
    ]
    assert np.abs(bounds - wanted).max() <= 1.5


def test_layers_are_the_same_in_every_tile_size_and_schedule(backend, renderer):
    """Four planes whose layers wait for one another, and splats of none."""
    planes = np.random.default_rng(9).choice([-1, -1, -1, 0, 1, 2, 3], 300)
    cloud = random_splats(300, seed=9, scale=(0.05, 0.5)).with_planes(planes)
    base, _ = traced(backend, cloud, fs.Quality())
    other, _ = traced(backend, cloud, fs.Quality(), shape=backend.shapes("schedule")["groups"])
    for name in ("rgb", "alpha", "normal", "depth"):
        assert np.abs(other[name] - base[name]).max() < 2e-5, name
    *_, (size, shape) = backend.shapes("tiles").items()
    again, _ = traced(backend, cloud, fs.Quality(), shape=shape)
    for name in ALL_OUTPUTS:
        assert np.array_equal(again[name], base[name]), f"{name} differs with {size}"


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
        for start, end in pairwise(trace["starts"]):
            places = np.flatnonzero(cloud.planes[trace["lists"][start:end]] == plane)
            assert len(places) == 0 or len(places) == np.ptp(places) + 1


def test_both_schedules_draw_the_same_picture(backend, renderer):
    cloud = random_splats(300, seed=9)
    base, _ = traced(backend, cloud, fs.Quality())
    other, _ = traced(backend, cloud, fs.Quality(), shape=backend.shapes("schedule")["groups"])
    for name in ("rgb", "alpha", "normal", "depth"):
        assert np.allclose(other[name], base[name], rtol=1e-5, atol=2e-6), name
    assert np.array_equal(other["label"], base["label"])


@pytest.mark.parametrize("scale", [(1e-3, 0.5), (0.1, 50.0)])
def test_both_ways_of_listing_give_the_same_lists(backend, scale):
    """Small splats and ones that touch more tiles than a window of list/tiled.cl has."""
    cloud = random_splats(2500, seed=5, scale=scale)
    tiled, ordered = (
        traced(backend, cloud, fs.Quality(lowpass="none"), shape=listing(backend, lists))[0]
        for lists in ("tiled", "ordered")
    )
    assert max(np.diff(tiled["starts"].astype(int))) > 20
    # both hold every tile that a splat touches (the test above) and may differ a little in what else
    different = 0
    for tile in range(len(tiled["starts"]) - 1):
        ours, theirs = (t["lists"][t["starts"][tile] : t["starts"][tile + 1]] for t in (tiled, ordered))
        different += len(set(theirs) ^ set(ours))
    assert different <= 0.05 * len(ordered["lists"])
    assert np.array_equal(tiled["rgb"], ordered["rgb"])


@pytest.mark.parametrize(
    ("lists", "budget"), [("ordered", 0), ("tiled", 0), ("gathered", 0), ("gathered", 5000)]
)
def test_views_of_a_batch_are_listed_apart(backend, monkeypatch, lists, budget):
    """gathered: tiles so few that they are counted in local memory, by groups of 4096 splats; with a budget
    of pairs in bands."""
    cloud = random_splats(5000, seed=5, scale=(1e-3, 0.5))
    quality = fs.Quality(lowpass="none")
    captures = [
        fs.Capture(fs.Camera.look_at(161, 117, 1.0, (x, 0.0, -0.1), (0.0, 0.0, 3.0)), ALL_OUTPUTS, quality)
        for x in (-1.0, 0.5)
    ]
    features, batch = prepare_batch(cloud, views_of(captures))
    shape = listing(backend, "tiled" if lists == "gathered" else lists)
    pipeline, resident = backend.pipeline(features, shape), backend.upload(cloud)
    alone = [pipeline.render(resident, prepare(cloud, capture)[1]) for capture in captures]
    gathered = GatheredLists._gather
    launched = []

    def gather(self, kernel, **given):
        launched.append(kernel)
        gathered(self, kernel, **given)

    monkeypatch.setattr(GatheredLists, "_gather", gather)
    if lists == "tiled":
        monkeypatch.setattr(GatheredLists, "TILES", 0)
    monkeypatch.setattr(backend, "pair_budget", budget or backend.pair_budget)
    pictures = pipeline.render_batch(resident, batch)
    assert (launched.count("emit_gathered") > (2 if budget else 0)) == (lists == "gathered")
    for name in ("visible", "pairs"):
        assert pictures.stats[name] == sum(picture.stats[name] for picture in alone)
    for picture, own in zip(pictures.read("rgb"), alone, strict=True):
        assert np.array_equal(picture, own.read("rgb"))


def test_lists_that_outgrow_their_buffers_are_made_again(backend):
    """A picture that has far more pairs, or big splats, than the last one."""
    groups = listing(backend, "tiled")
    few, many = random_splats(30, seed=2, scale=(1e-3, 0.05)), random_splats(9000, seed=2, scale=(0.5, 5.0))
    features, quality = select(few, fs.Capture(outputs=ALL_OUTPUTS)), fs.Quality()
    view = View.of(fs.Capture(CAMERA, quality=quality), few.origin)
    backend = type(backend)(backend.device)  # with buffers that no other test has made larger
    pipeline = backend.pipeline(features, groups)
    fresh = pipeline.render(backend.upload(many), view)
    wanted = {name: fresh.read(name) for name in ALL_OUTPUTS}
    backend = type(backend)(backend.device)
    pipeline = backend.pipeline(features, groups)
    pipeline.render(backend.upload(few), view)
    again = pipeline.render(backend.upload(many), view)
    assert again.stats == fresh.stats
    assert again.stats["pairs"] > 1e5
    for name in ALL_OUTPUTS:
        assert np.array_equal(again.read(name), wanted[name]), name


@pytest.mark.parametrize("spare", [1, 0, -1])
def test_room_for_exactly_the_pairs_of_a_picture(backend, spare):
    """Lists are made again if and only if there is no room for all of them."""
    cloud, quality = random_splats(3000, seed=5, scale=(1e-3, 0.5)), fs.Quality()
    groups = listing(backend, "tiled")
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS, quality))
    drawn = []
    for room in (None, spare):
        own = type(backend)(backend.device)  # with buffers of its own
        if room is not None:
            pairs = drawn[0].stats["pairs"] + room
            own.pool.scratch("lists", 4 * pairs)
            own.pool.scratch("pairs", 8 * pairs)
        drawn.append(own.pipeline(features, groups).render(own.upload(cloud), view))
        grown = own.pool.size("pairs") > 8 * (drawn[0].stats["pairs"] + spare)
        assert room is None or grown == (spare < 0)
    assert drawn[0].stats == drawn[1].stats
    for name in ALL_OUTPUTS:
        assert np.array_equal(drawn[0].read(name), drawn[1].read(name)), name


def test_a_list_longer_than_local_memory_is_sorted(backend):
    """tiles.cl sorts 2048 pairs at once in local memory, longer lists in global memory as well."""
    cloud = random_splats(11000, seed=8, depth=(1.0, 9.0), scale=(0.2, 0.3), across=0.1)
    trace, _ = traced(backend, cloud, fs.Quality(), shape=backend.shapes("schedule")["groups"])
    visible = np.flatnonzero(trace["keys"] != CULLED)
    assert max(np.diff(trace["starts"].astype(int))) > 8192
    assert out_of_order(trace, visible[np.argsort(trace["keys"][visible], kind="stable")]) == 0


def test_arrays_of_a_cloud_begin_anywhere(backend):
    """Kernels read whole vectors, and a CPU reads a cloud's own arrays."""
    base = random_splats(50, seed=6)
    arrays = {"quats": base.quats, "scales": base.scales}
    for name, array in arrays.items():
        flat = np.empty(array.size + 1, np.float32)
        flat[1:] = array.ravel()
        flat.flags.writeable = False
        arrays[name] = flat[1:].reshape(array.shape)
    cloud = fs.SplatCloud(means=base.means, opacities=base.opacities, colors=base.colors, **arrays)
    assert all(getattr(cloud, name).ctypes.data % 16 for name in arrays)
    pictures = [traced(backend, each, fs.Quality())[0]["rgb"] for each in (base, cloud)]
    assert np.array_equal(*pictures)


DEPTHS = {
    "spread": lambda n: np.linspace(1.0, 9.0, n),
    "in pairs": lambda n: np.linspace(1.0, 9.0, n // 2).repeat(2),
    "one": lambda n: np.full(n, 3.0),
    "two": lambda n: np.where(np.arange(n) % 3 == 0, 8.0, 2.0),
    "one far away": lambda n: np.r_[np.linspace(2.0, 2.001, n - 1), 1e14],
}


@pytest.mark.parametrize("depths", DEPTHS)
def test_a_list_is_sorted_however_its_depths_are_spread(backend, depths):
    """tiles.cl spreads a list over ranges of depth, and sorts it by a network where one is crowded."""
    n, generator = 1500, np.random.default_rng(4)
    cloud = random_splats(n, seed=4, scale=(0.05, 0.3))
    z = generator.permutation(DEPTHS[depths](n))
    cloud = fs.SplatCloud(
        means=np.stack([generator.normal(size=n) * 0.02 * z, generator.normal(size=n) * 0.02 * z, z], 1),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=cloud.scales * z[:, None],
        opacities=cloud.opacities,
        colors=cloud.colors,
    )
    camera = fs.Camera.pinhole(CAMERA.width, CAMERA.height, 150.0, 150.0, 80.0, 58.0)
    features, view = prepare(cloud, fs.Capture(camera, ALL_OUTPUTS))
    trace = backend.pipeline(features, backend.shapes("schedule")["groups"]).trace(
        backend.upload(cloud), view
    )
    visible = np.flatnonzero(trace["keys"] != CULLED)
    longest = max(np.diff(trace["starts"].astype(int)))
    assert 1000 < longest <= 1500
    assert out_of_order(trace, visible[np.argsort(trace["keys"][visible], kind="stable")]) == 0


@pytest.mark.parametrize("lists", ["ordered", "tiled"])
@pytest.mark.parametrize("budget", [1, 50, 1000])
def test_a_small_pair_budget_gives_the_same_bits(backend, monkeypatch, budget, lists):
    """numerics E3: a picture with more pairs than fit is drawn in bands of tiles."""
    cloud = random_splats(300, seed=12)
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS))
    # what lists in order draws a CPU's picture too: the way in which it is mostly drawn in bands
    shape = backend.shape if lists == "ordered" else listing(backend, lists)
    pipeline, resident = backend.pipeline(features, shape), backend.upload(cloud)
    whole = pipeline.render(resident, view)
    assert whole.stats["pairs"] > 1000
    monkeypatch.setattr(backend, "pair_budget", budget)
    banded = pipeline.render(resident, view)
    assert banded.stats == whole.stats
    for name in ALL_OUTPUTS:
        assert np.array_equal(banded.read(name), whole.read(name)), name
