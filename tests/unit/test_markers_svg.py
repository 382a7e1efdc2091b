"""Drawings: SVG outlines, the rectangles that cover them, their colours, and errors."""

import time

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

import fidsplat as fs
from fidsplat.markers import marker
from fidsplat.markers.cover import _intersecting, rotated
from fidsplat.markers.kinds import parse_spec
from fidsplat.markers.paths import circle_rings, path_rings
from fidsplat.markers.shapes import _crosses, filled
from fidsplat.markers.styles import COLORS
from fidsplat.scenes import PlacedMarker


def svg(folder, body: str, view: str = "0 0 40 20"):
    file = folder / "sign.svg"
    file.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{view}">{body}</svg>')
    return file


def rendered(folder, body: str, modules: int = 40, view: str = "0 0 40 20", **options):
    return marker(f"svg-{modules}:{svg(folder, body, view)}", **options)


def test_shapes_are_painted_one_over_the_other(tmp_path):
    drawing = rendered(
        tmp_path,
        '<rect x="2" y="3" width="10" height="8" fill="#ff0000"/>'
        '<g fill="blue" transform="translate(20 2)"><rect width="5" height="4"/><g transform="scale(2)">'
        '<rect x="3" y="1" width="2" height="2" style="fill: rgb(255, 0, 0)"/></g></g>'
        '<path d="M4 5h4v4h-4z" fill="white"/>',
    )
    expected = np.zeros((20, 40), int)
    expected[3:11, 2:12] = 1
    expected[2:6, 20:25] = 2
    expected[4:8, 26:30] = 1
    expected[5:9, 4:8] = 0
    assert np.array_equal(drawing.bits, expected)
    assert drawing.palette.tolist() == [[1, 1, 1], [1, 0, 0], [0, 0, 1]]
    assert (drawing.kind, drawing.quiet_zone, drawing.module) == ("svg", 0, 1 / 40)


def test_rectangles_of_whole_modules_are_as_few_as_can_be(tmp_path):
    drawing = rendered(tmp_path, '<path d="M10 5h20v10h-20z" fill="red"/>', quiet_zone=2)
    assert (drawing.regions, drawing.angles, drawing.boxes.dtype) == (None, None, np.int64)
    assert len(drawing.boxes) == 5


CURVED = (
    '<circle cx="12" cy="9" r="7" fill="#f80"/><ellipse cx="22" cy="10" rx="9" ry="6" fill="teal"/>'
    '<path d="M1 1L39 2 30 18 28 6Z" fill="navy"/><path d="M33 19L39 5" /><path d="M3 18.6L30 19 3 19.2z"/>'
)


def test_rectangles_cover_exactly_the_drawing(tmp_path):
    """Circles, obtuse and acute corners, a sliver thinner than a module, of either colour at an edge."""
    drawing = rendered(tmp_path, CURVED, quiet_zone=2)
    rectangles = np.array(shapely.polygons(rotated(drawing.boxes, drawing.boxes, drawing.angles)))
    assert drawing.palette.tolist()[0] == [1, 1, 1]
    assert len(drawing.regions) == len(drawing.palette) == 5
    assert sum(region.area for region in drawing.regions) == pytest.approx(drawing.grid.size, abs=1e-4)
    for value, region in enumerate(drawing.regions):
        union = shapely.union_all(rectangles[drawing.values == value])
        assert (region - union).area < 1e-6
        assert (union - region).area < 1e-3
        assert sum(shapely.area(rectangles[drawing.values == value])) < 1.5 * region.area + 1
    assert np.array_equal(drawing.cloud.colors, drawing.palette[drawing.values])
    assert drawing.components == len(drawing.polygons)
    y, x = np.indices(drawing.grid.shape) + 0.5
    for value, region in enumerate(drawing.regions):
        sure = shapely.distance(region.boundary, shapely.points(x, y)) > 1e-3
        assert np.array_equal((drawing.grid == value)[sure], shapely.contains_xy(region, x, y)[sure])


def test_gaussians_stay_within_their_colour(tmp_path):
    drawing = rendered(tmp_path, CURVED)
    fitted = drawing.gaussians
    x, y = (fitted.means[:, :2] / drawing.module + np.array(drawing.grid.shape[::-1]) / 2).T.astype(
        np.float64
    )
    for value, region in enumerate(drawing.regions):
        own = (fitted.colors == drawing.palette[value]).all(1)
        assert shapely.distance(region, shapely.points(x[own], y[own])).max() < 0.05


@settings(max_examples=60)
@example([(0.0, 0.0), (2.0, 1.0), (0.0, 1e-30), (2.0, 0.0), (0.0, 1.0)], False)
@given(st.lists(st.tuples(st.floats(-3, 15), st.floats(-3, 15)), min_size=3, max_size=8), st.booleans())
def test_what_rings_enclose(points, evenodd):
    """Against the winding number as the sum over triangles from one corner to each edge."""
    ring = np.array(points)
    actual = filled([ring], "evenodd" if evenodd else "nonzero")
    y, x = np.indices((12, 12)) + 0.5
    winding = np.zeros((12, 12), int)
    near = np.zeros((12, 12), bool)
    for a, b, c in zip([ring[0]] * len(ring), ring, np.roll(ring, -1, 0), strict=True):
        triangle = shapely.Polygon([a, b, c])
        if not triangle.area:
            continue
        near |= shapely.distance(triangle.exterior, shapely.points(x, y)) < 0.02
        turn = np.sign(np.cross(np.append(b - a, 0), np.append(c - a, 0))[2])
        winding += (turn * shapely.contains_xy(triangle, x, y)).astype(int)
    expected = winding % 2 == 1 if evenodd else winding != 0
    assert np.array_equal(shapely.contains_xy(actual, x, y)[~near], expected[~near])


def test_fill_rules():
    outer, inner = path_rings("M1 1H9V9H1Z M3 3H7V7H3Z")
    assert filled([outer, inner], "nonzero").area == 64
    assert filled([outer, inner], "evenodd").area == 64 - 16
    assert filled([outer, inner[::-1]], "nonzero").area == 64 - 16


@pytest.mark.parametrize("body", ["", '<circle r="0"/>', '<rect x="50" width="9" height="9"/>'])
def test_a_sheet_on_which_nothing_is_visible(tmp_path, body):
    assert len(rendered(tmp_path, body).boxes) == 1
    hidden = '<circle cx="9" cy="9" r="5" fill="red"/><rect width="40" height="20" fill="blue"/>'
    assert len(rendered(tmp_path, hidden).boxes) == 1


@pytest.mark.parametrize(
    ("path", "area"),
    [
        ("M0 0 10 0 10 10z", 50),
        ("m1,1 l10,0 0,10 -10,0", 100),
        ("M0 0H10V10H0ZM20 0h10v10h-10", 200),
        ("M-5 0A5 5 0 0 1 5 0A5 5 0 0 1-5 0", np.pi * 25),
        ("M-5 0A5 5 0 1 1 0 5L0 0", np.pi * 25 * 3 / 4),
        ("M0 0a10 5 90 0 0 0 20", np.pi * 25),
        ("M0 0Q5 10 10 0", 100 / 3),
        ("M0 0Q5 10 10 0T20 0", 0),
        ("M0 0C0 10 10 10 10 0", 60),
        ("M0 0c0 10 10 10 10 0s10-10 10 0", 0),
        ("M-5 0a5 5 0 0110 0 5 5 0 01-10 0", np.pi * 25),
    ],
)
def test_areas_of_paths(path, area):
    total = sum(
        np.sum(ring[:, 0] * np.roll(ring[:, 1], -1) - ring[:, 1] * np.roll(ring[:, 0], -1)) / 2
        for ring in path_rings(path)
    )
    assert abs(total) == pytest.approx(area, rel=3e-3, abs=1e-9)


def test_numbers_with_nothing_between_them():
    short, long = "m-5 0a5,5,0,01.5.5A5 5 0 1 0-5-1e0", "M-5 0a5 5 0 0 1 0.5 0.5 A5 5 0 1 0 -5 -1"
    assert np.array_equal(path_rings(short)[0], path_rings(long)[0])


def test_circles():
    (ring,) = circle_rings(3, 4, 2, 2)
    assert np.allclose(np.linalg.norm(ring - [3, 4], axis=1), 2)


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("<text>STOP</text>", "must have filled shapes, got <text>"),
        ('<rect width="5" height="5" stroke="red"/>', "<rect> must be filled paths, got a stroke"),
        ('<use href="#a"/>', "convert it to a path"),
        ('<rect width="5" height="5" fill="url(#a)"/>', "a fill must be"),
        ('<rect width="5" height="5" opacity="0.5"/>', "must be opaque, got opacity 0.5"),
        ('<g clip-path="url(#a)"/>', "<g> must be filled paths, got a clip-path"),
        ('<g transform="skewX(5 5)"/>', "skewX"),
        ('<g transform="rotate(45"/>', "rotate(45"),
        ('<g transform="rotate(45deg)"/>', "rotate(45deg)"),
        (
            '<rect width="5" height="5" style="transform: scale(2)"/>',
            "transform of <rect> must be",
        ),
        (
            '<style>rect { width: 9px }</style><rect width="5" height="5"/>',
            "width of <rect> must be",
        ),
        (
            "<style>g rect { fill: red }</style>",
            "style sheet must only have rules for .class, #id and tags, got 'g rect'",
        ),
        (
            '<style>@import "a.css";</style>',
            "style sheet must only have rules for .class, #id and tags, got '@import",
        ),
        (
            "<style>.a { fill: red !important }</style>",
            "style sheet must only have rules for .class, #id and tags, got !important",
        ),
        (
            '<rect width="5" height="5" style="display: none !important"/>',
            "the style of <rect> must be plain properties, got !important",
        ),
        ('<svg x="5"><rect width="5" height="5"/></svg>', "make it a group"),
        (
            '<path d="M0 0A5 5 0 2 0 9 9"/>',
            "cannot read <path>: a path must have commands and numbers, got '2",
        ),
        ('<path d="L5 5"/>', "must begin with M"),
        ('<path d="M0 0 L5"/>', "cannot read <path>: L must have a multiple of 2 numbers, got 1"),
        ('<path d="M0 0 # 5"/>', "cannot read <path>: a path must have commands and numbers, got '#"),
        ('<rect width="wide" height="5"/>', "cannot read <rect>"),
        ('<path d="M0 0H1e300V5"/>', "must be at most 1e"),
        ('<path d="M1 1h5 1e400 5C1 2 3 4 5 6"/>', "must be at most 1e"),
        ('<circle r="nan"/>', "must be at most 1e"),
        ('<g transform="rotate(1e400)"/>', "must be at most 1e"),
        (
            5 * '<g transform="scale(1e9)">' + 40 * "<g>" + '<rect width="9" height="9"/>' + 45 * "</g>",
            "must be at most 1e+09 modules, got ",
        ),
        ('<rect width="5" height="5" fill="rgb(%s,0,0)"/>' % ("9" * 5000), "a fill must be"),
        ('<rect width="5" height="5" opacity="50%"/>', "must be opaque"),
        ("<g>" * 200 + "</g>" * 200, "nested at most 100 deep"),
    ],
)
def test_unsupported_drawings_are_refused(tmp_path, body, says):
    with pytest.raises(fs.InputError) as error:
        rendered(tmp_path, body)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_no_drawings(tmp_path):
    file = tmp_path / "a.svg"
    for text, says in (
        ("", "as SVG"),
        ("<html/>", "begins with <html>"),
        ("<svg/>", r"must have a viewBox, or width and height, with sides from 1e-09 to 1e.09"),
        ('<svg viewBox="0 0 0 5"/>', "got 0 0 0 5"),
        ('<svg viewBox="2e9 0 10 10"/>', "got 2e.09 0 10 10"),
        ('<svg viewBox="0 0 1 100000"/>', "rows of modules"),
        ('<svg viewBox="0 0 1e-300 1e300"/>', "got 0 0 1e-300 1e.300"),
    ):
        file.write_text(text)
        with pytest.raises(fs.InputError, match=says):
            marker(f"svg:{file}")
    with pytest.raises(fs.InputError, match=r"cannot read .*: No such file"):
        marker(f"svg:{tmp_path / 'missing.svg'}")
    for text, says in (
        ("svg:", r"the spec of a drawing must be svg:FILE.svg, got 'svg"),
        ("svg-0:a", "1 to 2048"),
        ("svg-x:a", "svg-512:FILE"),
    ):
        with pytest.raises(fs.InputError, match=says):
            parse_spec(text)


def test_a_drawing_in_a_scene_file_is_next_to_it(tmp_path):
    drawing = rendered(tmp_path, '<rect width="20" height="20" fill="red"/>')
    fs.Scene(markers=[PlacedMarker(drawing)]).save(tmp_path / "scene.toml")
    assert 'spec = "svg-40:sign.svg"' in (tmp_path / "scene.toml").read_text()
    again = fs.Scene.load(tmp_path / "scene.toml").markers[0].marker
    assert np.array_equal(again.cloud.colors, drawing.cloud.colors)


def test_shapes_that_touch_the_sheet_leave_no_lines(tmp_path):
    """The first shape is outside of the sheet and shares an edge with it."""
    drawing = rendered(
        tmp_path, '<rect x="-5" width="5" height="9" fill="red"/><circle cx="9" cy="9" r="5"/>'
    )
    assert set(map(tuple, drawing.cloud.colors[:, :3])) == {(0, 0, 0), (1, 1, 1)}


def test_what_a_style_sheet_says(tmp_path):
    """Of equals the later; attributes, tags, classes, ids, an element's own: each over those before."""
    drawing = rendered(
        tmp_path,
        "<style>/* as it comes */ .a, .b { fill: #ff0000; } rect { fill: lime } .c.b { fill: navy }"
        " #it { visibility: hidden } .d { fill-rule: evenodd }</style>"
        '<rect class="a" width="5" height="5" fill="olive"/><rect x="10" width="5" height="5"/>'
        '<rect class="b c" x="20" width="5" height="5"/><g id="it"><rect x="30" width="5" height="5"/></g>'
        '<rect class="a" x="5" width="5" height="5" style="fill: currentColor" color="teal"/>'
        '<g fill="crimson"><path class="d" fill="inherit" d="M0 10h9v9h-9zM3 13h3v3h-3z"/></g>',
    )
    names = {"": (1, 1, 1)}
    expected = {(0, 0): (1, 0, 0), (10, 0): (0, 1, 0), (20, 0): (0, 0, 128 / 255), (30, 0): names[""]}
    expected |= {(5, 0): (0, 128 / 255, 128 / 255), (0, 10): (220 / 255, 20 / 255, 60 / 255)}
    expected |= {(4, 14): names[""]}
    for (x, y), color in expected.items():
        assert np.allclose(drawing.palette[drawing.bits[y, x]], color), (x, y)


def test_colours_have_the_names_of_css():
    from matplotlib.colors import CSS4_COLORS

    assert {name: f"#{digits}" for name, digits in COLORS.items()} == {
        name: digits.lower() for name, digits in CSS4_COLORS.items()
    }


def test_invisible_shapes_are_not_rendered(tmp_path):
    drawing = rendered(
        tmp_path,
        '<g visibility="hidden"><rect width="5" height="5"/><rect x="9" width="5" height="5" '
        'visibility="visible"/></g><rect y="9" width="5" height="5" fill="transparent"/>'
        '<switch><desc/><rect x="20" width="5" height="5" requiredExtensions="x"/>'
        '<rect x="25" width="5" height="5"/><rect x="30" width="5" height="5"/></switch>',
    )
    assert np.flatnonzero(drawing.bits.any(0)).tolist() == [*range(9, 14), *range(25, 30)]
    assert not drawing.bits[5:].any()


def test_round_corners(tmp_path):
    drawing = rendered(tmp_path, '<rect x="1px" y="2" width="30" height="16" rx="4" fill="red"/>')
    assert drawing.regions[1].area == pytest.approx(30 * 16 - (4 - np.pi) * 16, rel=1e-3)
    drawing = rendered(tmp_path, '<rect width="30" height="16" rx="99" ry="99" fill="red"/>')
    assert drawing.regions[1].area == pytest.approx(np.pi * 15 * 8, rel=1e-3)
    drawing = rendered(tmp_path, '<path d="M10 0h10v10h-10z" transform="skewX(45)" fill="red"/>')
    assert drawing.regions[1].bounds == pytest.approx((10, 0, 30, 10))


def test_curves_that_touch_make_no_heaps_of_gaussians(tmp_path):
    """Between them lie slivers of paper ten thousand times as long as wide."""
    body = '<rect width="40" height="20" rx="6" fill="red"/>'
    drawing = rendered(tmp_path, body)
    thin = (drawing.boxes[:, 2:] - drawing.boxes[:, :2]).min(1) < 1 / 64
    assert thin.sum() > 20
    assert len(drawing.gaussians) < 20_000
    assert np.array_equal(rendered(tmp_path, body, mixture="fitted").cloud.means, drawing.gaussians.means)


def test_scribbles_are_refused(tmp_path):
    places = " ".join(f"{7919 * i % 400 / 10} {104729 * i % 200 / 10}" for i in range(300))
    with pytest.raises(
        fs.InputError, match="must cross in at most 5000 places, got more; simplify the drawing"
    ):
        rendered(tmp_path, f'<path d="M{places}z"/>')


def test_one_outline_many_times_over_is_refused_soon(tmp_path):
    """Without crossings, but each piece of it has all others near."""
    begun = time.process_time()
    with pytest.raises(
        fs.InputError, match=r"at most 5,000,000 pairs of pieces near each other, got more; simplify"
    ):
        rendered(tmp_path, 3000 * '<rect width="9" height="9"/>')
    assert time.process_time() - begun < 10


def test_crossing_segments_are_those_of_geos():
    ends = np.random.default_rng(8).integers(0, 7, (2, 20_000, 2, 2)).astype(float)
    one, other = ends[:, (ends[:, :, 0] != ends[:, :, 1]).any(axis=2).all(axis=0)]
    expected = shapely.crosses(shapely.linestrings(one), shapely.linestrings(other))
    np.testing.assert_array_equal(_crosses(one, other), expected)


def test_which_modules_a_region_meets():
    rng = np.random.default_rng(5)
    for _ in range(20):
        h, w = map(int, rng.integers(1, 40, 2))
        region = shapely.union_all([shapely.Polygon(p).buffer(0) for p in rng.uniform(-5, 45, (3, 5, 2))])
        y, x = np.indices((h, w))
        assert np.array_equal(
            _intersecting(region, (h, w)), shapely.intersects(region, shapely.box(x, y, x + 1, y + 1))
        )


def test_heaps_of_shapes_are_refused(tmp_path):
    with pytest.raises(
        fs.InputError,
        match="a drawing must have at most 50000 pairs of overlapping shapes, got more; simplify it",
    ):
        rendered(tmp_path, 400 * '<rect width="9" height="9"/>')
