"""Each experiment at a small point: its measurements agree with independent ones."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.experiments import angles, counts, localisation, views
from fidsplat.experiments.methods import IDEAL, MarkerRenderer, method_names, mixtures
from fidsplat.experiments.setup import CATEGORIES, PROTOCOLS, novel_cameras
from fidsplat.images.files import to_uint8, write_png
from fidsplat.markers import marker
from fidsplat.util.response import linear_light, to_colors
from fidsplat.vision.metrics import psnr

pytestmark = pytest.mark.usefixtures("optimised")
BACKEND = "opencl"
CEILING = MarkerRenderer(None)


@pytest.fixture(scope="module")
def pool():
    with ThreadPoolExecutor(2) as pool:
        yield pool


def test_tilts_are_read_as_ranges():
    full = angles.parse_tilts(angles.FULL_TILTS)
    assert len(full) == 450
    assert (full[0], full[1], full[-1]) == (0.0, 0.2, 89.8)
    assert full == [round(0.2 * i, 6) for i in range(450)]
    assert angles.parse_tilts("60:61:0.5,0:10:10,60:60:1") == [0, 10, 60, 60.5, 61]
    for text in ("", "60", "0:90:1", "5:1:1", "0:10:0", "a:b:c", "-1:5:1", "0:10:1,"):
        with pytest.raises(fs.InputError, match="first:last:step"):
            angles.parse_tilts(text)


@pytest.mark.parametrize(
    ("hits", "expected"),
    [("11111", (4, 4)), ("11011", (4, 1)), ("01111", (4, None)), ("00000", (None, None)), ("11000", (1, 1))],
)
def test_the_largest_tilt_and_the_largest_without_a_miss_below(hits, expected):
    assert angles.largest([0, 1, 2, 3, 4], hits) == expected


def scan(protocol, category, method, tilts):
    return {"protocol": protocol, "category": category, "index": 0, "method": method, "tilts": tilts}


def located(category, distances, tilts, pool):
    point = {"category": category, "index": 0, "method": IDEAL, "distances": distances, "tilts": tilts}
    return localisation.measure_localisation(point, CEILING, 0, pool)["views"]


def test_scans_of_the_ideal_texture_find_its_ceiling(pool):
    point = scan("fixed-module", "small", IDEAL, "0:60:20,76:89:1")
    result = angles.measure_angles(point, CEILING, 0, pool, 2)
    tilts = angles.parse_tilts(point["tilts"])
    ends = {name: angles.largest(tilts, seen["read"]) for name, seen in result["readers"].items()}
    single, unbroken = ends["zxing-tall"]
    # a module of 8 px is 1.1 px high at 82.1 degrees, the limit that the research found
    assert 80 <= unbroken <= single <= 84
    assert ends["zxing"][0] < unbroken
    assert {len(text) for seen in result["readers"].values() for text in seen.values()} == {len(tilts)}
    for seen in result["readers"].values():
        assert all(
            actual == "1" for actual, read in zip(seen["found"], seen["read"], strict=True) if read == "1"
        )


@pytest.mark.sweep
def test_scans_do_not_hang_on_the_number_of_threads(renderer):
    markers = MarkerRenderer(renderer)
    for method in (IDEAL, "fitted/best"):
        point = scan("fixed-plane", "apriltag", method, "0:88:22")
        results = []
        for workers in (1, 4):
            with ThreadPoolExecutor(workers) as threads:
                results.append(angles.measure_angles(point, markers, 0, threads, workers))
        assert results[0] == results[1]
        assert "1" in results[0]["readers"]["pupil"]["read"]


@pytest.mark.sweep
@pytest.mark.parametrize(
    ("category", "tilts"), [("small", "0:44:22"), ("apriltag", "72:84:6"), ("medium", "0:40:20")]
)
def test_fitted_markers_are_read_wherever_the_ideal_is(renderer, pool, category, tilts):
    """OpenCV's detectors stumble over grey in the quiet zone, which ends of long rectangles would leave."""
    collected = []
    for method in (IDEAL, "fitted/best"):
        point = scan("fixed-plane", category, method, tilts)
        actual = angles.measure_angles(point, MarkerRenderer(renderer), 0, pool, 2)["readers"]
        collected.append({name: one["read"] for name, one in actual.items()})
    assert "0" not in collected[0]["aruco" if category == "apriltag" else "cv2"]
    assert collected[1] == collected[0]


def test_every_mixture_but_facets_is_a_row_with_both_filters():
    assert mixtures()[:2] == ("paper", "fitted")
    names = method_names()
    assert names[:5] == (IDEAL, "paper/screen", "paper/best", "fitted/screen", "fitted/best")
    assert len(names) == 1 + 2 * (len(mixtures()) - 1)
    assert method_names(("facets",)) == (IDEAL, "facets/screen", "facets/best")
    assert method_names(("fitted",)) == (IDEAL, "fitted/screen", "fitted/best")
    with pytest.raises(fs.InputError, match="unknown mixture 'boxes'; known: paper, fitted"):
        method_names(("boxes",))


def test_every_method_puts_the_marker_where_the_ideal_has_it(renderer):
    spec = CATEGORIES["small"].spec(0)
    protocol = PROTOCOLS["fixed-plane"]
    module = protocol.module(marker(spec).grid.shape[0])
    markers = MarkerRenderer(renderer)
    camera = protocol.camera(35.0)
    ideal = markers.prepare(IDEAL, "small-0", spec, module)(camera)
    for name in method_names()[1:]:
        image = markers.prepare(name, "small-0", spec, module)(camera)
        assert image.shape == ideal.shape
        match = psnr(image, ideal)
        shifted = max(psnr(np.roll(image, step, axis), ideal) for step in (-1, 1) for axis in (0, 1))
        assert match > shifted + 3


def test_trained_models_are_rows_where_they_are(renderer, tmp_path):
    """A model that is our own marker, saved as a trainer saves it, is rendered like our own marker."""
    spec = CATEGORIES["apriltag"].spec(2)
    sign = fs.marker(spec, 2.0 * 8 / 10)
    folder = tmp_path / "2dgs-9"
    folder.mkdir()
    fs.save_ply(sign.gaussians, folder / "apriltag-2.ply")
    assert method_names(("fitted",), tmp_path)[-1] == "2dgs-9"
    markers = MarkerRenderer(renderer, tmp_path)
    for name in ("fixed-plane", "fixed-module"):
        protocol = PROTOCOLS[name]
        draws = [
            markers.prepare(m, "apriltag-2", spec, protocol.module(10)) for m in ("2dgs-9", "paper/screen")
        ]
        trained, own = (draw(protocol.camera(20.0)) for draw in draws)
        assert psnr(trained, own) > 20
    with pytest.raises(fs.InputError, match="apriltag-0"):
        markers.prepare("2dgs-9", "apriltag-0", spec, 0.2)
    with pytest.raises(fs.InputError, match="a folder of trained models must be given"):
        MarkerRenderer(renderer).prepare("2dgs-9", "apriltag-2", spec, 0.2)
    with pytest.raises(fs.InputError, match="a renderer must be given"):
        CEILING.prepare("fitted/best", "apriltag-2", spec, 0.2)


def part_of(method: str, truth: str, number: int = 2) -> dict:
    facts = {"category": "small", "index": 0, "method": method, "truth": truth, "views": number}
    return facts | {"flip": True, "lpips": None}


def test_views_of_the_ideal_texture(pool, tmp_path):
    equal = views.measure_views(part_of(IDEAL, "exact"), CEILING, 0, tmp_path, pool)
    assert equal["psnr"] == [None, None]
    assert equal["ssim"] == pytest.approx([1.0, 1.0])
    assert equal["flip"] == [0.0, 0.0]
    assert equal["lpips"] is None
    without = part_of(IDEAL, "exact-linear") | {"flip": False}
    linear = views.measure_views(without, CEILING, 0, tmp_path, pool)
    assert linear["flip"] is None
    category = CATEGORIES["small"]
    for value, camera in zip(linear["psnr"], novel_cameras(category, 0), strict=False):
        one, other = (to_uint8(views.exact_view(category.spec(0), camera, x)) / 255 for x in (False, True))
        assert value == pytest.approx(psnr(one, other), abs=1e-9)  # of 8 bits, against a peak of 255
        assert 30 < value < 36


def test_images_are_rendered_once_for_all_truths(pool, tmp_path):
    """Cached images belong to the right marker, method and ground truth."""
    rendered = []

    class Counting(MarkerRenderer):
        def prepare(self, method, name, spec, module):
            draw = super().prepare(method, name, spec, module)

            def counted(camera):
                rendered.append(name)
                return draw(camera)

            return counted

    truths = [(0, "exact"), (0, "exact-linear"), (0, "exact"), (1, "exact-linear"), (1, "exact")]
    points = [part_of(IDEAL, expected) | {"index": index, "flip": False} for index, expected in truths]
    counting = Counting(None)
    measured = [views.measure_views(point, counting, 0, tmp_path, pool) for point in points]
    assert rendered == ["small-0", "small-0", "small-1", "small-1"]
    assert measured == [
        views.measure_views(point, MarkerRenderer(None), 0, tmp_path, pool) for point in points
    ]


def test_views_by_the_renderer_with_every_metric(renderer, pool, tmp_path):
    point = part_of("fitted/best", "exact")
    measured = views.measure_views(
        point, MarkerRenderer(renderer), 0, tmp_path, pool, lambda a, b: float(abs(a - b).max())
    )
    assert all(27 < value < 40 for value in measured["psnr"])
    assert all(0.9 < value < 1 for value in measured["ssim"])
    assert all(0 < value < 0.2 for value in measured["flip"])
    assert len(measured["lpips"]) == 2


def test_blenders_images_take_part_where_a_marker_has_all_of_them(pool, tmp_path):
    category = CATEGORIES["small"]
    camera = novel_cameras(category, 0)[0]
    for index, number in ((0, 0), (0, 1), (1, 0)):
        file = views.image_file(tmp_path, "raw", "small", index, "test", number)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_png(file, to_uint8(views.exact_view(category.spec(0), camera, False)))
    points = views.views_points([category], [IDEAL], tmp_path, markers=2, views=2)
    assert [(point["index"], point["truth"]) for point in points] == [
        (0, "exact-linear"),
        (0, "blender-raw"),
        (1, "exact-linear"),
    ]
    point = points[1] | {"flip": False}
    measured = views.measure_views(point, CEILING, 0, tmp_path, pool)
    assert measured["psnr"][0] is None  # the first view is in its place, the second is another view's image
    assert measured["psnr"][1] < 20
    write_png(views.image_file(tmp_path, "raw", "small", 0, "test", 1), np.zeros((10, 10), np.uint8))
    with pytest.raises(fs.InputError, match="must have the shape"):
        views.measure_views(point, CEILING, 0, tmp_path, pool)


def test_the_srgb_curve_and_its_inverse():
    values = np.linspace(0, 1, 101)
    assert to_colors(linear_light(values, "srgb"), "srgb") == pytest.approx(values, abs=1e-9)
    assert to_colors(np.array(0.2), "srgb") * 255 == pytest.approx(123.6, abs=0.1)


def test_counts_of_a_marker_that_one_can_count():
    result = counts.measure_counts({"category": "apriltag", "index": 0, "repeats": 2}, 0)
    grid = marker("apriltag:36h11:0").grid
    dark = int(grid.sum())
    assert result["cells"] == {"dark": dark, "light": grid.size - dark}
    rows = [[len(list(run)) for run in np.split(row, np.flatnonzero(np.diff(row)) + 1)] for row in grid]
    assert sum(result["runs"].values()) == sum(map(len, rows))
    markers = {name: fs.marker("apriltag:36h11:0", mixture=name) for name in mixtures()}
    assert result["rectangles"] == {
        "dark": sum(box.dark for box in markers["fitted"].rectangles),
        "light": sum(not box.dark for box in markers["fitted"].rectangles),
    }
    assert sum(result["components"].values()) == markers["fitted"].components
    assert sum(result["rectangles"].values()) < sum(result["runs"].values()) < sum(result["cells"].values())
    for name, one in markers.items():
        assert result["gaussians"][name]["rectangles"] == len(one.cloud)
        assert len(result["seconds"][name]) == 2
        assert min(result["seconds"][name]) > 0
    assert result["gaussians"]["paper"]["cells"] == 107 * grid.size
    # every module is a square, which takes the template of short rectangles
    assert result["gaussians"]["fitted"]["cells"] == 25 * grid.size


def test_gaussians_of_the_minimum_partition_by_the_rule_for_others():
    """The count for other partitions, applied to the minimum one, is the cloud's."""
    for name in mixtures():
        sign = fs.marker("qr-v2-L:count me", mixture=name)
        expected = None if name == "facets" else len(sign.cloud)  # a module's, however they are cut
        assert counts._gaussians(name, sign.boxes) == expected


@pytest.mark.parametrize("category", localisation.LOCATED)
def test_localisation_on_the_ideal_texture(category, pool):
    actual = located(category, [0.6, 1.0], [0.0, 50.0], pool)
    assert [(v["distance_m"], v["tilt_deg"]) for v in actual] == [(0.6, 0), (0.6, 50), (1, 0), (1, 50)]
    for view in actual:
        assert view["position_mm"] < 0.01 * 1000 * view["distance_m"]
        assert view["angle_deg"] < 2.0
        assert view["corners_px"] < 0.1


def test_errors_of_poses_are_millimetres_and_degrees(pool, monkeypatch):
    monkeypatch.setattr(localisation, "pose_error", lambda found, true: (0.0015, np.radians(2.0)))
    (view,) = located("small", [0.6], [0.0], pool)
    assert (view["position_mm"], view["angle_deg"]) == pytest.approx((1.5, 2.0))


def test_a_marker_that_is_not_read_has_no_errors(pool):
    (view,) = located("small", [40.0], [0.0], pool)
    assert (view["position_mm"], view["angle_deg"], view["corners_px"]) == (None, None, None)


def test_cameras_of_localisation_are_where_they_say():
    for distance, tilt in ((0.5, 0.0), (3.0, 70.0)):
        camera = localisation.camera_at(distance, tilt, "x")
        assert np.linalg.norm(camera.position) == pytest.approx(distance)
        assert -camera.position[2] / distance == pytest.approx(np.cos(np.radians(tilt)))
        assert not np.allclose(camera.project([[0, 0, 0]]), [640, 360], atol=1e-3)
