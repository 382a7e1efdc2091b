"""The parts of a training step, each against a written-out twin: loss, Adam, random numbers, neighbours,
densification, MCMC."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.train import TrainSettings, densify, mcmc, neighbours
from fidsplat.train.losses import C1, C2, blurred, image_loss, normal_loss, window
from fidsplat.train.neighbours import mean_square_distances
from fidsplat.train.optimiser import adam_step, parameter_gradients
from fidsplat.train.parameters import Splats, TrainingError, logit, sigmoid
from fidsplat.train.random_numbers import RandomStream, normal, permutation, philox, uniform


def images(seed=0, size=(9, 12)):
    random = np.random.default_rng(seed)
    return random.uniform(-0.1, 1.1, (2, *size, 3))


def splats_of(count, seed=0, degree=1):
    random = np.random.default_rng(seed)
    shapes = {"means": (3,), "log_scales": (2,), "quats": (4,), "logits": (), "sh": ((degree + 1) ** 2, 3)}
    splats = Splats.of({name: random.normal(size=(count, *shape)) for name, shape in shapes.items()})
    for group in (splats.first, splats.second):
        for array in group.values():
            array[:] = random.uniform(0.1, 1, array.shape)
    return splats


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("masked", [False, True])
def test_the_gradient_of_the_loss_is_that_of_central_differences(weight, masked):
    image, expected = images()
    mask = np.random.default_rng(1).uniform(size=image.shape[:2]) < 0.6 if masked else None
    _, gradient = image_loss(image, expected, mask, weight)
    random = np.random.default_rng(2)
    for _ in range(40):
        place = tuple(random.integers(image.shape))
        values = []
        for change in (1e-5, -1e-5):
            moved = image.copy()
            moved[place] += change
            values.append(image_loss(moved, expected, mask, weight)[0].value)
        assert gradient[place] == pytest.approx((values[0] - values[1]) / 2e-5, abs=1e-9)
        if masked and not mask[place[:2]]:
            assert gradient[place] == 0


def solid(size=(7, 9)):
    """Depths of a bent surface with a hole, normals in any direction, coverage."""
    random = np.random.default_rng(4)
    rows, columns = np.mgrid[: size[0], : size[1]]
    depth = 2 + 0.05 * rows - 0.03 * columns + 0.02 * random.normal(size=size)
    depth[2, 6] = 0
    normals = random.normal(size=(*size, 3))
    return depth, normals / np.linalg.norm(normals, axis=2, keepdims=True), random.uniform(0.2, 1, size)


def test_the_gradient_of_the_loss_of_normals_is_that_of_central_differences():
    depth, normals, alpha = solid()
    lens = (6.0, 7.0), (4.2, 3.1)
    _, by_depth, by_normal = normal_loss(depth, normals, alpha, *lens)
    for array, actual in ((depth, by_depth), (normals, by_normal)):
        for place in np.ndindex(array.shape):
            if array is depth and depth[place] == 0:
                assert actual[place] == 0
                continue
            ends = []
            for change in (1e-6, -1e-6):
                old_value, array[place] = array[place], array[place] + change
                ends.append(normal_loss(depth, normals, alpha, *lens)[0])
                array[place] = old_value
            assert actual[place] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-9)
        assert np.abs(actual).max() > 1e-3


def test_a_plane_has_the_normals_of_its_depths():
    """Of a slanted plane the loss is 0 with its own normal, and twice the share of pixels inside with the
    opposite one."""
    rows, columns = np.mgrid[:8, :10]
    normal = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])
    rays = np.stack([(columns + 0.5 - 5) / 9, (rows + 0.5 - 4) / 9, np.ones((8, 10))], 2)
    depth = -2.0 / (rays @ normal)
    normals, alpha = np.tile(normal, (8, 10, 1)), np.ones((8, 10))
    lens = (9.0, 9.0), (5.0, 4.0)
    assert normal_loss(depth, normals, alpha, *lens)[0] == pytest.approx(0, abs=1e-12)
    assert normal_loss(depth, -normals, alpha, *lens)[0] == pytest.approx(2 * 6 * 8 / 80)


def test_the_loss_is_what_its_definition_says():
    """SSIM written out pixel by pixel: a window of 11 that sees zeros beyond the image."""
    image, expected = images(size=(5, 7))
    weights = np.outer(window(), window())
    similar = []
    for c in range(3):
        a, b = (np.pad(picture[:, :, c], 5) for picture in (image, expected))
        for y in range(5):
            for x in range(7):
                p, q = (each[y : y + 11, x : x + 11] for each in (a, b))
                mean_p, mean_q = (weights * p).sum(), (weights * q).sum()
                var_p = (weights * p * p).sum() - mean_p**2
                var_q = (weights * q * q).sum() - mean_q**2
                shared = (weights * p * q).sum() - mean_p * mean_q
                top = (2 * mean_p * mean_q + C1) * (2 * shared + C2)
                similar.append(top / ((mean_p**2 + mean_q**2 + C1) * (var_p + var_q + C2)))
    loss, _ = image_loss(image, expected, None, 0.2)
    l1 = np.abs(image - expected).mean()
    assert loss.value == pytest.approx(0.8 * l1 + 0.2 * (1 - np.mean(similar)), rel=1e-12)
    assert loss.psnr == pytest.approx(-10 * np.log10(np.mean((image - expected) ** 2)))
    assert image_loss(expected, expected, None, 0.2)[0].psnr == np.inf
    np.testing.assert_allclose(blurred(np.ones((30, 30, 1)))[15, 15], 1)


def test_a_value_that_is_not_finite_is_detected_unless_it_is_masked():
    image, expected = images()
    image[3, 4, 1] = np.nan
    assert np.isnan(image_loss(image, expected, None, 0.2)[0].value)
    mask = np.ones(image.shape[:2], bool)
    mask[3, 4] = False
    assert np.isfinite(image_loss(image, expected, mask, 0.2)[0].value)


def test_adam_takes_the_step_that_is_written_out():
    settings, rate = (
        TrainSettings(),
        {"means": 0.1, "log_scales": 0.2, "quats": 0.3, "logits": 0.4, "sh": 0.5},
    )
    splats, gradients = splats_of(6), splats_of(6, seed=1).values
    before = {name: [group[name].astype(float) for group in splats._groups] for name in gradients}
    adam_step(splats, gradients, rate, settings, 7)
    for name, (value, first, second) in before.items():
        g = gradients[name].astype(float)
        m, v = 0.9 * first + 0.1 * g, 0.999 * second + 0.001 * g * g
        rates = np.full(value.shape, rate[name])
        if name == "sh":
            rates[:, 1:] /= 20
        expected = value - rates * (m / (1 - 0.9**7)) / (np.sqrt(v / (1 - 0.999**7)) + 1e-15)
        np.testing.assert_allclose(splats.values[name], expected, rtol=2e-5, atol=2e-6)
        np.testing.assert_allclose(splats.first[name], m, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(splats.second[name], v, rtol=1e-5)


def test_coefficients_that_were_not_rendered_stay():
    splats = splats_of(5, degree=2)
    before = splats.values["sh"].copy()
    gradients = splats_of(5, seed=1, degree=1).values
    adam_step(splats, gradients, dict.fromkeys(gradients, 0.1), TrainSettings(), 1)
    np.testing.assert_array_equal(splats.values["sh"][:, 4:], before[:, 4:])
    assert (splats.values["sh"][:, :4] != before[:, :4]).all()


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
@pytest.mark.parametrize("plain", [False, True])
def test_gradients_by_inner_values_are_those_of_central_differences(strategy, plain):
    """For a loss that is linear in the rendered images, with the penalties that mcmc adds."""
    settings = TrainSettings(strategy=strategy)
    splats, random = splats_of(4, degree=0 if plain else 1), np.random.default_rng(3)
    cloud = splats.cloud(0 if plain else 1, np.zeros(3))
    names = ("means", "quats", "scales", "opacities", "colors" if plain else "sh")

    def shown(values):
        quats = values["quats"] / np.linalg.norm(values["quats"], axis=1, keepdims=True)
        actual = {"means": values["means"], "quats": quats, "scales": np.exp(values["log_scales"])}
        actual["opacities"] = sigmoid(values["logits"])
        color = np.maximum(values["sh"][:, 0] * 0.28209479177387814 + 0.5, 0)
        return actual | ({"colors": color} if plain else {"sh": values["sh"]})

    start = {name: array.astype(np.float64) for name, array in splats.values.items()}
    weights = {name: random.normal(size=shown(start)[name].shape) for name in names}
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_allclose(getattr(cloud, name), shown(start)[name], rtol=1e-5, atol=1e-6)

    def loss(values):
        actual = shown(values)
        total = sum((actual[name] * weights[name]).sum() for name in names)
        if strategy == "mcmc":
            total += 0.01 * actual["opacities"].mean() + 0.01 * actual["scales"].mean()
        return total

    result = parameter_gradients(splats, weights, settings)
    for name, array in start.items():
        for place in np.ndindex(array.shape):
            values = []
            for change in (1e-6, -1e-6):
                moved = {**start, name: array.copy()}
                moved[name][place] += change
                values.append(loss(moved))
            assert result[name][place] == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-4, abs=1e-6)


def test_philox_gives_what_its_authors_print():
    """Known answers of Random123 for philox4x32-10."""
    ones = 0xFFFFFFFF
    known = (
        ((0, 0, 0, 0), 0, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((ones,) * 4, ones | ones << 32, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            0xA4093822 | 0x299F31D0 << 32,
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    )
    for counter, key, answer in known:
        assert tuple(philox(np.array([counter], np.uint32), key)[0]) == answer


def test_random_numbers_are_of_their_splat_iteration_and_purpose_only():
    few, many = (uniform(5, RandomStream.SPLITS, 100, count) for count in (10, 1000))
    np.testing.assert_array_equal(few, many[:10])
    others = [(6, RandomStream.SPLITS, 100), (5, RandomStream.NOISE, 100), (5, RandomStream.SPLITS, 101)]
    for other in others:
        assert (uniform(*other, 10) != few).all()
    assert (uniform(5, RandomStream.SPLITS, 100, 10, draw=1) != few).all()
    assert ((many > 0) & (many < 1)).all()
    draws = normal(5, RandomStream.NOISE, 1, 20_000)
    assert np.abs(draws.mean(0)).max() < 0.03
    assert np.abs(np.cov(draws.T) - np.eye(4)).max() < 0.03
    assert sorted(permutation(0, RandomStream.VIEWS, 3, 50)) == list(range(50))


@pytest.mark.parametrize("pairs", [None, 1000])
def test_neighbours_are_those_of_all_pairs(pairs, monkeypatch):
    """All of a box at once, and few of them: strays may have to be compared with all points."""
    if pairs is not None:
        monkeypatch.setattr(neighbours, "_PAIRS", pairs)
    random = np.random.default_rng(0)
    points = np.concatenate([random.normal(size=(900, 3)), random.normal(5, 0.01, (300, 3))])
    squares = ((points[:, None] - points) ** 2).sum(2)
    np.testing.assert_allclose(
        mean_square_distances(points), np.sort(squares, axis=1)[:, 1:4].mean(1), rtol=1e-9
    )
    np.testing.assert_allclose(mean_square_distances(points[:2]), squares[0, 1])
    assert mean_square_distances(points[:1]).tolist() == [0]


def test_neighbours_are_sought_in_the_boxes_nearby(monkeypatch):
    """A grid of 20,000 points: the pairs compared grow with the points, not with their square."""
    compared, nearest = 0, neighbours._nearest

    def counted(mine, among):
        nonlocal compared
        compared += len(mine) * len(among)
        return nearest(mine, among)

    monkeypatch.setattr(neighbours, "_nearest", counted)
    points = np.stack(np.meshgrid(np.arange(40), np.arange(25), np.arange(20)), -1).reshape(-1, 3)
    assert (mean_square_distances(points) == 1).all()
    assert compared < len(points) ** 2 / 4


def ready(count=8):
    """Splats with ids as their colours, of opacity 0.5 and 1 cm."""
    splats = splats_of(count)
    splats.values["logits"][:] = 0
    splats.values["log_scales"][:] = np.log(0.01)
    splats.values["sh"][:, 0, 0] = np.arange(count)
    splats.visible_counts[:] = 4
    return splats


def ids(splats):
    return splats.values["sh"][:, 0, 0].astype(int).tolist()


def test_densification_keeps_the_order_and_puts_new_splats_behind():
    settings, splats = TrainSettings(), ready()
    splats.gradient_sums[[1, 2, 5]] = 4 * settings.gradient_threshold
    splats.gradient_sums[3] = 3.99 * settings.gradient_threshold  # in 4 images: below the threshold
    splats.values["log_scales"][[2, 5]] = np.log(0.03)  # larger than a hundredth of the extent
    splats.values["logits"][7] = logit(0.04)
    old = splats.select(slice(None))
    densified = densify.densification(splats, settings, 600, extent=2.0).apply(splats)
    assert ids(densified) == [0, 1, 3, 4, 6, 1, 2, 5, 2, 5]
    survivors = old.select(np.array([0, 1, 3, 4, 6]))
    for name in survivors.values:
        np.testing.assert_array_equal(densified.values[name][:5], survivors.values[name])
        np.testing.assert_array_equal(densified.first[name][:5], survivors.first[name])
        assert not densified.first[name][5:].any()
        assert not densified.second[name][5:].any()
    np.testing.assert_array_equal(densified.values["means"][5], old.values["means"][1])  # a clone
    np.testing.assert_allclose(densified.scales[6:], 0.03 / 1.6, rtol=1e-5)
    np.testing.assert_array_equal(densified.values["quats"][6:], old.values["quats"][[2, 5, 2, 5]])
    away = densified.values["means"][6:] - old.values["means"][[2, 5, 2, 5]]
    assert (np.abs(away[:2] - away[2:]).max(axis=1) > 1e-4).all()  # the parts of a splat are apart
    assert (np.abs(away).max(axis=1) > 0).all()
    turns = quaternion_to_matrix(old.values["quats"][[2, 5, 2, 5]])
    assert np.abs(np.einsum("ni,ni->n", away, turns[:, :, 2])).max() < 1e-6  # within their disks
    assert not densified.gradient_sums.any()
    assert not densified.visible_counts.any()


def test_a_faint_splat_goes_though_it_would_be_split():
    settings, splats = TrainSettings(), ready()
    splats.gradient_sums[[1, 2]] = 4 * settings.gradient_threshold
    splats.values["log_scales"][[1, 2]] = np.log(0.03)
    splats.values["logits"][1] = logit(0.04)
    densified = densify.densification(splats, settings, 600, extent=2.0).apply(splats)
    assert ids(densified) == [0, 3, 4, 5, 6, 7, 2, 2]
    splats.values["logits"][1] = logit(0.5)
    occluding = np.isin(np.arange(8), [1, 5])  # in front of a marker
    densified = densify.densification(splats, settings, 600, 2.0, ~occluding).apply(splats)
    assert ids(densified) == [0, 3, 4, 6, 7, 2, 2]


def test_no_more_splats_are_made_than_allowed():
    settings, splats = TrainSettings(max_splats=10), ready()
    splats.gradient_sums[[1, 2, 5, 6]] = np.array([2, 1, 3, 2]) * 4 * settings.gradient_threshold
    assert ids(densify.densification(splats, settings, 600, 2.0).apply(splats)) == [*range(8), 1, 5]


def test_large_splats_go_after_the_first_reset():
    settings = TrainSettings()
    for iteration, left in ((600, 8), (3000, 8), (3001, 7)):
        splats = ready()
        splats.values["log_scales"][4] = np.log(0.3)
        assert len(densify.densification(splats, settings, iteration, 2.0).rows) == left
    splats.values["logits"][:] = logit(0.01)
    with pytest.raises(TrainingError, match=r"all splats were pruned after iteration 600"):
        densify.densification(splats, settings, 600, 2.0)


def test_mcmc_moves_the_dead_and_grows_up_to_its_limit():
    settings = TrainSettings(strategy="mcmc", max_splats=41)
    splats = ready(40)
    splats.values["logits"][[3, 9]] = logit(0.004)
    densified = mcmc.relocate_and_grow(splats, settings, 600)
    assert len(densified) == 41
    assert [i for i, new in enumerate(ids(densified)[:40]) if i != new] == [3, 9]
    # two that stand for one let through what the one did
    sources = [ids(densified)[3], ids(densified)[9], ids(densified)[40]]
    for source in sources:
        copies = ids(densified).count(source)
        together = 1 - (1 - densified.opacities[source]) ** copies
        assert together == pytest.approx(0.5, rel=1e-4)
    assert not densified.first["means"][sources[:2]].any()
    for place, source in zip((3, 9, 40), sources, strict=True):
        assert_looks_like(densified, [source, place], ids(densified).count(source))
    splats.values["logits"][:] = logit(0.004)
    with pytest.raises(TrainingError, match=r"must be above .* for at least one splat"):
        mcmc.relocate_and_grow(splats, settings, 600)


def assert_looks_like(splats, rows, copies):
    """Equal splats at one place block as much light along a line through it as the splat of `ready`."""
    x = np.linspace(-0.1, 0.1, 4001)
    for row in rows:
        for scale in splats.scales[row]:
            each = splats.opacities[row] * np.exp(-0.5 * (x / scale) ** 2)
            one = 0.5 * np.exp(-0.5 * (x / 0.01) ** 2)
            assert (1 - (1 - each) ** copies).sum() == pytest.approx(one.sum(), rel=1e-4)


def test_mcmc_moves_a_splat_of_exactly_the_dead_opacity():
    splats = ready(12)
    splats.values["logits"][4] = -3
    exactly = TrainSettings(strategy="mcmc", growth=1.0, dead_opacity=float(splats.opacities[4]))
    assert ids(mcmc.relocate_and_grow(splats, exactly, 600))[4] != 4


def test_densification_takes_a_gradient_of_exactly_the_threshold():
    splats = ready()
    splats.gradient_sums[2] = 1.0
    exactly = TrainSettings(gradient_threshold=0.25)
    assert ids(densify.densification(splats, exactly, 600, 2.0).apply(splats)) == [*range(8), 2]


def test_mcmc_shakes_faint_splats_within_their_disks():
    settings, splats = TrainSettings(strategy="mcmc"), ready(40)
    splats.values["logits"][:20] = logit(0.001)
    before = splats.values["means"].copy()
    mcmc.add_noise(splats, settings, 5, 1e-4)
    away = splats.values["means"] - before
    assert np.abs(away[:20]).max(axis=1).min() > 100 * np.abs(away[20:]).max()
    turns = quaternion_to_matrix(splats.values["quats"])
    assert np.abs(np.einsum("ni,ni->n", away, turns[:, :, 2])).max() < 1e-6


def test_settings_outside_their_range_are_errors():
    assert TrainSettings().position_rate_at(7000) == pytest.approx(5.46e-5, rel=1e-3)
    assert [TrainSettings().degree_at(i) for i in (999, 1000, 9000)] == [0, 1, 3]
    wrong = {
        "beta1": 1,
        "beta2": 1.0,
        "initial_opacity": 0,
        "reset_opacity": 0.0,
        "mcmc_opacity": 1,
        "iterations": 0,
        "seed": -1,
        "strategy": "best",
        "sh_degree": 4,
        "color_rate": np.nan,
        "dssim_weight": 2,
        "max_splats": True,
        "quality": "fine",
    }
    with pytest.raises(fs.InputError, match="must be text"):  # which a checkpoint could not hold
        TrainSettings(quality=fs.Quality())  # type: ignore[arg-type]
    for name, value in wrong.items():
        with pytest.raises(fs.InputError):
            TrainSettings(**{name: value})
