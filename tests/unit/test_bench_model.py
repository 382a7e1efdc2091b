"""Minimum cost of a frame (roofline), and growth of times."""

import dataclasses

import pytest
from growth import exponents, points
from tables import exponent

from fidsplat.backends.interface import Rates
from fidsplat.experiments.bench.model import FRAGMENT_FMA, RECORD, Counts, Work, roofline_ms, roofline_work

COUNTS = Counts(splats=1000, visible=600, pairs=4000, fragments=90_000, pixels=64 * 48)
RATES = Rates(copy_bytes=1e9, fma=1e9, exp=1e8, division=2e8)


def test_memory_and_arithmetic_overlap_and_kinds_of_arithmetic_add_up():
    assert Work(bytes=2e6).ms(RATES) == pytest.approx(2.0)
    assert Work(fma=1e6, exp=1e5, division=1e5).ms(RATES) == pytest.approx(1.0 + 1.0 + 0.5)
    assert Work(bytes=2e6, fma=1e6).ms(RATES) == pytest.approx(2.0)
    assert Work(bytes=2e6, fma=3e6).ms(RATES) == pytest.approx(3.0)


def test_the_blend_stage_by_hand():
    blend = roofline_work(COUNTS)["blend"]
    assert blend.bytes == 4 * 4000 + RECORD * 600
    assert (blend.fma, blend.exp, blend.division) == (FRAGMENT_FMA * 90_000, 90_000, 90_000)
    # arithmetic: 2.7 ms of multiply-adds, 0.9 ms of exp, 0.45 ms of divisions
    assert roofline_ms(COUNTS, RATES)["blend"] == pytest.approx(2.7 + 0.9 + 0.45)


def test_every_stage_that_a_frame_names_has_a_roofline(renderer):
    import fidsplat as fs

    tag = fs.marker("apriltag:36h11:5").gaussians
    timings = renderer.render(tag, fs.Camera.pinhole(8, 8, 8, 8, 4, 4)).timings
    assert set(roofline_work(COUNTS)) >= set(timings)


@pytest.mark.parametrize("what", ["splats", "visible", "pairs", "fragments", "pixels"])
def test_more_to_render_never_costs_less(what):
    more = dataclasses.replace(COUNTS, **{what: 10 * getattr(COUNTS, what)})
    before, after = roofline_ms(COUNTS, RATES), roofline_ms(more, RATES)
    assert all(after[stage] >= before[stage] for stage in before)
    assert sum(after.values()) > sum(before.values())


def test_colours_that_depend_on_the_view_are_read_of_visible_splats_only():
    degree_3 = roofline_work(dataclasses.replace(COUNTS, sh_coefficients=15))["project"]
    plain = roofline_work(COUNTS)["project"]
    assert degree_3.bytes - plain.bytes == 600 * 15 * 12


def test_nothing_to_render_costs_only_the_image():
    least = roofline_ms(Counts(0, 0, 0, 0, 1000), RATES)
    assert least.pop("resolve") == pytest.approx(0.012)
    assert set(least.values()) == {0.0}


# --- growth


def test_exponents_of_power_laws_are_found():
    x = [1e4, 3e4, 1e5, 3e5, 1e6]
    assert exponent(x, [7e-3 * v**1.25 for v in x]) == pytest.approx(1.25)
    # what is fixed and hides the law among the small ones does not count
    assert exponent(x, [5.0, 5.0, 1e5**0.5, 3e5**0.5, 1e6**0.5]) == pytest.approx(0.5)
    assert exponent([10.0], [1.0]) is None
    assert exponent([10.0, 20.0], [1.0, 0.0]) is None


def record(title: str, series: str, x: float, ms: float, **changes) -> dict:
    row = {"title": title, "series": series, "x": x, "frame_ms": 2 * ms, "fastest_ms": ms, "error": None}
    return row | {"stages_ms": {"blend": ms}, "fastest_stages_ms": {"blend": ms / 2}} | changes


def test_exponents_by_device_and_series_leave_out_what_failed():
    records = [record("cpu", "splats", x, x**0.5) for x in (100.0, 10.0, 1000.0)]
    records += [record("gpu", "overdraw", f, f, layers_per_pixel=f**2) for f in (1.0, 2.0, 4.0)]
    records.append({"title": "gpu", "series": "overdraw", "x": 8.0, "error": "no memory"})
    actual = {(title, series): powers for title, series, powers in exponents(records)}
    assert actual["cpu", "splats"] == {"frame": pytest.approx(0.5), "blend": pytest.approx(0.5)}
    assert actual["gpu", "overdraw"]["frame"] == pytest.approx(0.5)  # over the layers, not the factor


def test_series_cover_what_they_promise():
    series = points()
    over_splats, over_pixels = series["splats"], series["pixels"]
    assert (over_splats[0].count, over_splats[-1].count) == (10_000, 20_000_000)
    covered = [point.count * point.median_scale**2 for point in over_splats]
    assert covered == pytest.approx([covered[0]] * len(covered))
    for point, expected in zip(over_pixels, (0.25e6, 0.5e6, 1e6, 2e6, 4e6, 8e6), strict=True):
        assert point.x == point.width * point.height == pytest.approx(expected, rel=0.02)
        assert point.width * 9 == point.height * 16
    for row in series.values():
        assert [point.x for point in row] == sorted({point.x for point in row})
