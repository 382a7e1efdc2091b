"""marker(): its splats, their frame, and errors."""

import random
import string
import subprocess
import sys

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.capture.quality import NESTED
from fidsplat.images.files import write_png
from fidsplat.markers import Marker, Rectangle, marker


def text_of(length: int) -> str:
    return "".join(random.Random(1).choices(string.ascii_letters + string.digits, k=length))


def coverage(sign: Marker, per_module: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """The marker over grey as coplanar splats are rendered, in NumPy, and the marker as it is printed."""
    cloud = sign.gaussians
    h, w = sign.grid.shape
    x = ((np.arange(w * per_module) + 0.5) / per_module - w / 2) * sign.module
    y = ((np.arange(h * per_module) + 0.5) / per_module - h / 2) * sign.module
    means, scales = cloud.means.astype(float), cloud.scales.astype(float)
    reach = np.sqrt(2 * np.log(255 * cloud.opacities))
    x0, x1 = (np.searchsorted(x, means[:, 0] + side * reach * scales[:, 0]) for side in (-1, 1))
    y0, y1 = (np.searchsorted(y, means[:, 1] + side * reach * scales[:, 1]) for side in (-1, 1))
    depth, shone = np.full((len(y), len(x)), 1e-12), np.zeros((len(y), len(x)))
    for i in range(len(cloud)):
        at = np.s_[y0[i] : y1[i], x0[i] : x1[i]]
        gx = np.exp(-0.5 * ((x[at[1]] - means[i, 0]) / scales[i, 0]) ** 2)
        gy = np.exp(-0.5 * ((y[at[0]] - means[i, 1]) / scales[i, 1]) ** 2)
        alpha = cloud.opacities[i] * np.outer(gy, gx)
        tau = -np.log(np.maximum(1 - np.where(alpha < 1 / 255, 0, alpha), 2.0**-24))
        depth[at] += tau
        shone[at] += tau * cloud.colors[i, 0]
    left = np.exp(-depth)
    shown = (1 - left) * shone / depth + left * 0.5
    return shown, np.kron(1.0 - sign.grid, np.ones((per_module, per_module)))


def psnr(sign: Marker) -> float:
    shown, printed = coverage(sign)
    return float(-10 * np.log10(np.mean((shown - printed) ** 2)))


def test_frame_size_and_corners():
    sign = fs.marker("apriltag:36h11:5", size=0.16)
    assert isinstance(sign, Marker)
    assert sign.module == pytest.approx(0.02)
    assert sign.quiet_zone == 1
    assert np.allclose(sign.corners, [[-0.08, -0.08, 0], [0.08, -0.08, 0], [0.08, 0.08, 0], [-0.08, 0.08, 0]])
    cloud = sign.cloud
    assert (cloud.means[:, 2] == 0).all()
    assert np.array_equal(cloud.quats, np.tile(np.float32([1, 0, 0, 0]), (len(cloud), 1)))
    assert np.abs(cloud.means).max() < 0.1
    assert set(np.unique(cloud.colors)) == {0, 1}
    assert (cloud.coplanar_groups == 0).all()
    assert not cloud.dropped
    assert (cloud.labels == 0).all()
    assert sign.seconds > 0
    assert "apriltag:36h11:5" in repr(sign)


def test_upright_as_printed():
    """x right and y down: the image is the grid, neither turned nor mirrored; it fits best as it is."""
    sign = marker("aruco:4x4_50:7")
    shown, printed = coverage(sign, 6)
    error = np.mean((shown - printed) ** 2)
    for turned in (np.rot90(printed), printed.T, printed[::-1], printed[:, ::-1]):
        assert error < 0.1 * np.mean((shown - turned) ** 2)


def test_size_scales_everything():
    small, large = marker("aruco:5x5_50:3", size=0.1), marker("aruco:5x5_50:3", size=2.0)
    assert np.allclose(large.cloud.means, 20 * small.cloud.means, rtol=1e-6, atol=1e-9)
    assert np.allclose(large.cloud.scales, 20 * small.cloud.scales, rtol=1e-6)


def test_rectangles_components_and_polygons():
    sign = marker("apriltag:36h11:0")
    assert sign.components == len(sign.polygons)
    assert sum(polygon.area for polygon in sign.polygons) == sign.grid.size
    assert all(isinstance(rectangle, Rectangle) for rectangle in sign.rectangles)
    for x0, y0, x1, y1, dark in sign.rectangles:
        assert (sign.grid[y0:y1, x0:x1] == dark).all()
    assert sum((r.x1 - r.x0) * (r.y1 - r.y0) for r in sign.rectangles) == sign.grid.size
    assert type(sign.rectangles[0].x0) is int


def test_the_paper_s_mixture_has_its_options():
    sign = marker("apriltag:36h11:0", mixture="paper")
    n = len(sign.boxes)
    assert len(sign.cloud) == 107 * n
    assert len(marker("apriltag:36h11:0", mixture="paper", duplicates=True).cloud) == 135 * n
    assert len(marker("apriltag:36h11:0", mixture="paper", levels=2, density=1).cloud) == 9 * n
    grown = marker("apriltag:36h11:0", mixture="paper", growth=0.3)
    assert len(grown.cloud) == 107 * n
    assert psnr(grown) > psnr(sign) + 1


@pytest.mark.parametrize("spec", ["apriltag:36h11:0", "apriltag:25h9:3", "aruco:4x4_50:7"])
def test_fitted_is_nearer_to_the_print_with_a_quarter_of_the_splats(spec):
    """Here by the formula; benchmarks/marker_quality.py measures the renderer's images."""
    fitted, paper = marker(spec, mixture="fitted"), marker(spec, mixture="paper")
    assert 3.5 * len(fitted.cloud) < len(paper.cloud)
    assert psnr(fitted) > 23
    assert psnr(fitted) > psnr(paper) + 2.5
    assert psnr(fitted) > psnr(marker(spec, mixture="fitted", growth=0.0))


def in_order(sign: Marker, angle: float, per_module: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Light over grey, and alpha, as other renderers composite: one splat after the other by their centres'
    depth, here along a direction of the plane; alphas at most 0.99, cut off at 1/255.
    """
    cloud = sign.gaussians
    h, w = sign.grid.shape
    x = ((np.arange(w * per_module) + 0.37) / per_module - w / 2) * sign.module
    y = ((np.arange(h * per_module) + 0.37) / per_module - h / 2) * sign.module
    means, scales = cloud.means.astype(float), cloud.scales.astype(float)
    reach = np.sqrt(2 * np.log(255))
    x0, x1 = (np.searchsorted(x, means[:, 0] + side * reach * scales[:, 0]) for side in (-1, 1))
    y0, y1 = (np.searchsorted(y, means[:, 1] + side * reach * scales[:, 1]) for side in (-1, 1))
    light, left = np.zeros((len(y), len(x))), np.ones((len(y), len(x)))
    for i in np.argsort(means[:, 0] * np.cos(angle) + means[:, 1] * np.sin(angle), kind="stable"):
        at = np.s_[y0[i] : y1[i], x0[i] : x1[i]]
        gx = np.exp(-0.5 * ((x[at[1]] - means[i, 0]) / scales[i, 0]) ** 2)
        gy = np.exp(-0.5 * ((y[at[0]] - means[i, 1]) / scales[i, 1]) ** 2)
        alpha = np.minimum(cloud.opacities[i] * np.outer(gy, gx), 0.99)
        alpha = np.where(alpha < 1 / 255, 0.0, alpha)
        light[at] += left[at] * alpha * cloud.colors[i, 0]
        left[at] *= 1 - alpha
    return light + left * 0.5, 1 - left


@pytest.mark.parametrize("angle", [0.3, 3.8])
def test_the_nested_template_is_opaque_and_clean_in_any_order(angle):
    sign = marker("aruco:4x4_50:7", mixture="fitted", template=NESTED)
    shown, alpha = in_order(sign, angle)
    error = shown - np.kron(1.0 - sign.grid, np.ones((24, 24)))
    assert alpha[1:-1, 1:-1].min() > 0.999  # but for 2 % of a module, less than a sample
    assert -10 * np.log10(np.mean(error**2)) > 35
    inside = np.tile(np.arange(24) % 23 > 0, len(error) // 24)  # cells less a sample on each side
    assert np.abs(error[np.ix_(inside, inside)]).max() < 0.02


def test_no_hairs_stand_out_of_the_paper():
    """A line that is much longer than its rectangle gains a few tenths of a decibel and shows as a hair."""
    sign = marker("apriltag:36h11:5", mixture="fitted")
    edge = sign.grid.shape[1] * sign.module / 2
    low, high = sign.cloud.bounds()
    assert np.all(np.abs([low[:2], high[:2]]) < 1.4 * edge)


def test_fitted_beats_paper_on_a_qr_code():
    spec = f"qr-v2-L:{text_of(20)}"
    fitted, paper = marker(spec, mixture="fitted"), marker(spec, mixture="paper")
    assert 4 * len(fitted.cloud) <= len(paper.cloud)
    assert psnr(fitted) > psnr(paper) + 2.5


def test_the_same_bits_on_every_run():
    first, second = (marker(f"qr:{text_of(100)}").gaussians for _ in range(2))
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"size": 0}, "size must be a length from 1e-9 to 1e9 metres, got 0"),
        ({"size": -0.1}, r"size must be a length from 1e-9 to 1e9 metres, got -0.1"),
        ({"size": float("nan")}, "size must be a length from 1e-9 to 1e9 metres, got nan"),
        ({"size": 1e-12}, "from 1e-9 to 1e9 metres"),
        ({"size": "large"}, "size must be a length from 1e-9 to 1e9 metres, got 'large"),
        ({"mixture": "fited"}, "fitted, paper"),
        ({"quiet_zone": -1}, "whole number from 0"),
        ({"quiet_zone": 0.5}, "whole number from 0"),
        ({"quiet_zone": 10**6}, "quiet zone must be .* got 1000000"),
        ({"mixture": "fitted", "growth": 1.5}, r"marker quality: growth must be 0 to 1 module"),
        ({"mixture": "fitted", "growth": "much"}, r"marker quality: growth must be 0 to 1 module"),
        ({"levels": 4}, "mixture='paper'"),
        ({"mixture": "paper", "levels": 40}, "1 to 8"),
        (
            {"mixture": "facets", "template": 9},
            "template must be given with mixture exact or fitted, got facets; leave it",
        ),
        (
            {"mixture": "facets", "growth": 0.1},
            "growth must be given with mixture fitted or paper, got facets; leave it",
        ),
        ({"mixture": "facets", "max_splats": 587}, "at most 587 splats, got 588"),
        ({"max_splats": 0}, "max_splats must be .* got 0"),
        ({"max_splats": "many"}, "whole number from 1"),
        ({"max_splats": 10}, "apriltag:36h11:0 must have at most 10 splats, got at least"),
    ],
)
def test_bad_options_are_refused(options, says):
    with pytest.raises(fs.InputError, match=says):
        marker("apriltag:36h11:0", **options)


@pytest.fixture(scope="module")
def noise(tmp_path_factory):
    bits = np.random.default_rng(0).random((120, 120)) < 0.5
    return f"image:{write_png(tmp_path_factory.mktemp('noise') / 'noise.png', bits)}"


def test_too_many_splats_are_refused_before_the_work(noise, monkeypatch):
    def partition(grid):
        raise AssertionError("cut into rectangles all the same")

    monkeypatch.setattr("fidsplat.markers.build.partition_colors", partition)
    with pytest.raises(
        fs.InputError, match=r"at most 100,000 splats, got at least 1\d\d,\d{3}; .*max_splats"
    ):
        marker(noise, mixture="fitted", max_splats=100_000)


def test_too_many_splats_are_refused_by_their_number(noise):
    count = len(marker(noise, mixture="fitted").cloud)
    assert len(marker(noise, mixture="fitted", max_splats=count).cloud) == count
    with pytest.raises(fs.InputError, match=f"at most {count - 1:,} splats, got {count:,}"):
        marker(noise, mixture="fitted", max_splats=count - 1)


def test_an_exact_marker_may_have_more_boxes_than_gaussians(noise):
    sign = marker(noise, mixture="exact", max_splats=100_000)
    assert len(sign.cloud) == len(sign.boxes)
    with pytest.raises(fs.InputError, match=r"as Gaussians image:.* at most 100,000 splats"):
        _ = sign.gaussians


def test_clouds_are_filled_part_by_part_bit_identically(noise, monkeypatch):
    for mixture in ("fitted", "exact"):
        whole, messages = marker(noise, mixture=mixture).cloud, []
        with monkeypatch.context() as patched:
            patched.setattr("fidsplat.markers.printing.CHUNK", 4321)
            parts = marker(noise, mixture=mixture, progress=lambda *now, to=messages: to.append(now)).cloud
        for name in ("means", "scales", "opacities", "colors", "quats"):
            assert np.array_equal(getattr(whole, name), getattr(parts, name))
        assert [words for words, _ in messages[:2]] == ["components", "rectangles"]
        shares = [share for words, share in messages if words == "splats"]
        assert shares == sorted(shares)
        assert 0 == shares[0] < shares[-1] < 1


def test_a_large_checkerboard(tmp_path):
    """Every module becomes a rectangle: an algorithm of more than linear time would not end."""
    bits = np.indices((1000, 1000)).sum(0) % 2 == 1
    spec = f"image:{write_png(tmp_path / 'board.png', bits)}"
    sign = marker(spec, mixture="exact")
    assert len(sign.cloud) == sign.components == 1_000_000
    with pytest.raises(fs.InputError, match="at least 25,000,000"):
        marker(spec, mixture="fitted")


def test_the_quiet_zone():
    assert marker("qr:x").quiet_zone == 4
    assert marker("aruco:4x4_50:0").quiet_zone == 1
    bare = marker("apriltag:36h11:0", quiet_zone=0)
    assert bare.grid.shape == bare.bits.shape
    wide = marker("apriltag:36h11:0", quiet_zone=5)
    assert wide.grid.shape == (18, 18)
    assert (wide.grid[:5] == 0).all()
    assert np.array_equal(wide.corners, bare.corners)


def test_a_marker_is_frozen():
    sign = marker("aruco:4x4_50:0")
    for array in (sign.bits, sign.grid, sign.boxes, sign.labels, sign.cloud.means):
        assert not array.flags.writeable


def test_importing_markers_is_light():
    heavy = ("numpy", "shapely", "networkx", "segno", "cv2")
    code = f"import sys, fidsplat.markers; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_corners_of_a_marker_that_is_not_square():
    sign = fs.marker("gridboard:2x1:4x4_50", size=0.7, mixture="exact")
    half = 0.35, 0.35 * sign.bits.shape[0] / sign.bits.shape[1]
    np.testing.assert_allclose(sign.corners[:, :2], half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    assert half[1] < half[0]
