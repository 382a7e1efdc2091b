"""Worn markers: areas and contrast by severity, seeds, detection, and errors."""

from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.images.files import to_uint8, write_png
from fidsplat.markers import Cylinder, Wear
from fidsplat.markers.wear import COVER, EFFECTS, SOIL
from fidsplat.scenes import PlacedMarker
from fidsplat.vision.detect import detect

BACKEND = "opencl"  # for the fixture `renderer`
SPEC, SIZE = "apriltag:36h11:5", 0.16
SHEET = 0.2**2
"""m^2 of the marker with its quiet zone"""


def areas(marker: fs.Marker) -> dict[tuple[float, ...], float]:
    """Area of the boxes of each colour, in m^2."""
    own = 4 * marker.cloud.scales.astype(float).prod(1)
    colors, index = np.unique(marker.cloud.colors.astype(float).round(3), axis=0, return_inverse=True)
    totals = np.bincount(index.ravel(), own)
    return {tuple(color.tolist()): total for color, total in zip(colors, totals, strict=True)}


def worn(severity: float, effect: str, seed: int = 1) -> fs.Marker:
    return fs.marker(SPEC, SIZE, wear=Wear(**{effect: severity}, seed=seed))


NEW = areas(fs.marker(SPEC, SIZE))
INK = NEW[0.0, 0.0, 0.0]


@pytest.mark.parametrize("effect", EFFECTS)
def test_severity_0_is_the_new_marker_and_seeds_are_reproducible(effect):
    plain = fs.marker(SPEC, SIZE)
    zero = worn(0.0, effect)
    assert zero.wear is None
    assert np.array_equal(zero.cloud.means, plain.cloud.means)
    one, again, other = worn(0.4, effect), worn(0.4, effect), worn(0.4, effect, seed=2)
    for name in ("means", "scales", "colors"):
        assert np.array_equal(getattr(one.cloud, name), getattr(again.cloud, name))
    if effect != "fading":
        assert not (len(one.cloud) == len(other.cloud) and np.array_equal(one.cloud.means, other.cloud.means))
    for marker in (one, worn(1.0, effect)):
        assert np.array_equal(marker.corners, plain.corners)
        assert np.array_equal(marker.boxes, plain.boxes)


def test_fading_loses_contrast_and_no_area():
    marker = fs.marker(SPEC, SIZE, black=(0.1, 0.1, 0.1), white=(0.9, 0.9, 0.9), wear=Wear(fading=0.25))
    dark_areas = areas(marker)
    assert dark_areas == {(0.3, 0.3, 0.3): pytest.approx(INK), (0.9, 0.9, 0.9): pytest.approx(SHEET - INK)}


@pytest.mark.parametrize("severity", [0.1, 0.5, 1.0])
def test_areas_are_those_of_the_severity(severity):
    cell = 1.001 * SHEET / 160**2
    cover = areas(worn(severity, "cover"))
    assert cover[COVER] == pytest.approx(severity * SHEET, abs=cell)
    assert sum(cover.values()) == pytest.approx(SHEET)
    torn = areas(worn(severity, "tear"))
    assert sum(torn.values()) == pytest.approx((1 - 0.75 * severity) * SHEET, abs=cell)
    # within each colour, dirt of eight opacities: all of the soiled area has changed its colour
    soiled = areas(worn(severity, "dirt"))
    clean = sum(soiled.get(color, 0.0) for color in NEW)
    assert clean == pytest.approx((1 - severity) * SHEET, abs=cell)
    assert soiled.get(SOIL, 0.0) < severity * SHEET
    # scratches overlap, and remove ink where they meet ink only
    scratched = areas(worn(severity, "scratches"))
    assert INK - 0.5 * severity * SHEET < scratched[0.0, 0.0, 0.0] < INK
    # the flap hides as much as it leaves: up to two triangles of the sheet's corner
    folded = sum(areas(worn(severity, "fold")).values())
    legs = 0.9 * severity * 0.2
    assert SHEET - legs**2 / 2 - 0.002 * SHEET < folded < SHEET - 0.6 * legs**2 / 2 + 0.002 * SHEET


def test_ink_bleeds_by_less_than_a_cell():
    ink = [areas(worn(severity, "bleed"))[0.0, 0.0, 0.0] for severity in (0.08, 0.1, 0.13)]
    assert all(np.diff([INK, *ink]) > 0)


def test_ink_bleeds_by_a_distance_on_average(tmp_path):
    """A square of ink grows by a rounded rim: 4 a r + pi r^2."""
    file = write_png(tmp_path / "square.png", np.pad(np.zeros((4, 4), np.uint8), 1, constant_values=255))
    marker = fs.marker(f"image:{file}", SIZE, quiet_zone=2, wear=Wear(bleed=0.6, seed=3))
    module = marker.module
    side, reach = 4 * module, 0.5 * 0.6 * module
    grown = areas(marker)[0.0, 0.0, 0.0] - side**2
    ideal = 4 * side * reach + np.pi * reach**2
    assert grown == pytest.approx(ideal, rel=0.25)
    dark = marker.cloud.means[marker.cloud.colors[:, 0] == 0]
    assert np.abs(dark[:, :2]).max() < side / 2 + 1.3 * reach + module / 16


def test_a_detector_reads_light_wear_and_fails_at_the_end(renderer):
    camera = fs.Camera.look_at(160, 160, 0.75, (0.0, -0.03, -0.3), (0, 0, 0))

    def read(wear: Wear, shape=None) -> bool:
        marker = fs.marker(SPEC, SIZE, wear=wear, shape=shape)
        image = renderer.render(marker.cloud, camera, background=(0.4, 0.5, 0.6))["rgb"]
        return SPEC in [code.name for code in detect(to_uint8(image), ["apriltag:36h11"])]

    for effect in EFFECTS:
        slight = 0.02 if effect in ("scratches", "dirt", "cover") else 0.1
        assert read(Wear(**{effect: slight})), effect
        if effect != "drops":  # which show the code below them
            assert not read(Wear(**{effect: 1.0})), effect
    assert read(Wear(fading=0.3, bleed=0.1, dirt=0.02), Cylinder(0.2))
    assert not read(Wear(fading=0.3, bleed=1.0), Cylinder(0.2))


def test_wear_of_each_kind_of_marker_and_mixture(tmp_path):
    for spec in ("qr:hello", "charuco:3x3:4x4_50", "apriltag:circle21h7:3"):
        marker = fs.marker(spec, SIZE, wear="dirt=0.2,scratches=0.1,seed=4")
        assert marker.wear == Wear(dirt=0.2, scratches=0.1, seed=4)
        assert sum(areas(marker).values()) == pytest.approx(sum(areas(fs.marker(spec, SIZE)).values()))
        assert set(marker.cloud.coplanar_groups.tolist()) == {0}
    bent = fs.marker("apriltag:16h5:3", SIZE, "fitted", template=5, wear=Wear(tear=0.2), shape=Cylinder(0.1))
    assert np.abs(np.hypot(bent.cloud.means[:, 0], 0.1 - bent.cloud.means[:, 2]) - 0.1).max() < SIZE / 1500
    assert len(fs.marker(SPEC, SIZE, wear=Wear(fold=0.3)).gaussians) > 25
    scene = fs.Scene(markers=[PlacedMarker(fs.marker(SPEC, SIZE, wear=Wear(drops=0.1, seed=7)))])
    scene.save(tmp_path / "scene.toml")
    read = fs.Scene.load(tmp_path / "scene.toml").markers[0].marker
    assert read.wear == scene.markers[0].marker.wear
    assert np.array_equal(read.cloud.colors, scene.markers[0].marker.cloud.colors)


def test_wrong_wear_is_refused(tmp_path):
    with pytest.raises(fs.InputError, match=r"dirt must be a severity from 0 to 1, got 1\.5"):
        Wear(dirt=1.5)
    with pytest.raises(fs.InputError, match="seed must be a whole number"):
        replace(Wear(dirt=0.5), seed=-1)
    with pytest.raises(fs.InputError, match="did you mean 'fading'"):
        fs.marker(SPEC, wear="fadin=0.5")
    with pytest.raises(fs.InputError, match="wear must be a Wear, its text or None"):
        fs.marker(SPEC, wear=0.5)
    with pytest.raises(fs.InputError, match="got facets; use exact"):
        fs.marker(SPEC, mixture="facets", wear="fading=0.5")
    drawing = tmp_path / "a.svg"
    drawing.write_text('<svg viewBox="0 0 9 9"><path d="M1 1L8 2L4 8Z" fill="black"/></svg>')
    with pytest.raises(fs.InputError, match="which has slanted edges; use another family"):
        fs.marker(f"svg-16:{drawing}", wear="fading=0.5")
    (tmp_path / "scene.toml").write_text(f'[[markers]]\nspec = "{SPEC}"\nsize = 1.0\nwear = {{dirt = 2}}\n')
    with pytest.raises(fs.InputError, match=r"markers\[0\]\.wear: dirt must be a severity"):
        fs.Scene.load(tmp_path / "scene.toml")
    text = 'shape = "cylinder,radius=0.9"\nwear = "dirt=0.2"\n'
    (tmp_path / "text.toml").write_text(f'[[markers]]\nspec = "{SPEC}"\nsize = 1.0\n{text}')
    made = fs.Scene.load(tmp_path / "text.toml").markers[0].marker
    assert (made.shape, made.wear) == (Cylinder(0.9), Wear(dirt=0.2))
