"""Scenes of `fidsplat tradeoff`: splats, hard cases, markers at three tilts, and the user's files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import MarkerQuality
from fidsplat.experiments.bench.catalogue import BenchScene
from fidsplat.experiments.setup import BACKGROUND, CATEGORIES, PROTOCOLS
from fidsplat.markers import Marker, marker
from fidsplat.scenes.random_clouds import load_scene
from fidsplat.selftest.hard_scene import hard_scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.provenance import digest_of

RANDOM = ("r100k_720p", "r1m_1080p")
GAUSSIANS_3D = ("r100k_720p_3d", "r1m_1080p_3d")
"""scenes of 3D Gaussians, for the values of `ellipsoid`"""
HARD = "hard"
MARKERS = {"apriltag": "apriltag", "qr2": "small", "qr5": "medium", "qr10": "large", "qr22": "huge"}
"""category of the paper by name; its marker 0 is used"""
FEW_SETTINGS = ("apriltag", "qr2", "qr5", "qr22")
"""markers for which only presets and marker qualities are measured; qr10 has every setting"""
NAMES = (*RANDOM, *GAUSSIANS_3D, HARD, *MARKERS)
QUICK_NAMES = ("r100k_720p", HARD, "apriltag", "qr10")
TILTS = (0, 60, 80)
"""tilts in degrees"""
PROTOCOL = PROTOCOLS["fixed-plane"]
"""camera of markers: a plane of 2 x 2 m at a distance of 4 m, in 800 x 800 pixels"""
GREY = (BACKGROUND, BACKGROUND, BACKGROUND)
"""background of a marker's plane"""
SEED = 0


@dataclass(frozen=True, eq=False)
class TradeScene:
    """View of a scene to render."""

    name: str
    """`qr10@60` is the marker qr10 at 60 degrees"""
    cloud: SplatCloud
    camera: Camera
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    marker: Marker | None = None
    """marker with the module of `PROTOCOL`"""

    @cached_property
    def capture(self) -> Capture:
        return Capture(self.camera, background=self.background)


def scene_names(names: Iterable[str], quick: bool = False) -> tuple[str, ...]:
    """Distinct scene names; by default all, or those of a quick run.

    Raises:
        InputError: an unknown scene.
    """
    names = tuple(dict.fromkeys(names)) or (QUICK_NAMES if quick else NAMES)
    for name in names:
        if name not in NAMES:
            raise InputError(unknown("scene", name, NAMES))
    return names


def views_of(name: str) -> tuple[str, ...]:
    """Names of a scene's views: its own name, or `NAME@TILT` for each tilt of a marker."""
    return tuple(f"{name}@{tilt}" for tilt in TILTS) if name in MARKERS else (name,)


def is_marker(view: str) -> bool:
    """Whether a name of a view or scene is a marker's."""
    return view.partition("@")[0] in MARKERS


def make_view(view: str, quality: MarkerQuality) -> TradeScene:
    """View by its name in `views_of`. Raises InputError for an unknown mixture or template of the marker."""
    name, _, tilt = view.partition("@")
    if name in MARKERS:
        placed = placed_marker(name, quality)
        return TradeScene(view, placed.cloud, PROTOCOL.camera(float(tilt)), GREY, placed)
    cloud, camera = hard_scene(SEED) if name == HARD else load_scene(name, SEED)
    return TradeScene(view, cloud, camera)


@lru_cache(maxsize=32)
def placed_marker(name: str, quality: MarkerQuality) -> Marker:
    """Marker by name on its plane of 2 x 2 m, including the quiet zone."""
    spec = CATEGORIES[MARKERS[name]].spec(0, SEED)
    plain = marker(spec)
    module = PROTOCOL.module(plain.grid.shape[0])
    return marker(spec, module * plain.bits.shape[1], quality=quality)


Views = Mapping[str, TradeScene]
"""the user's views by name"""


def user_views(views: Mapping[str, BenchScene]) -> dict[str, TradeScene]:
    """Views of the user's `fidsplat bench` scenes, with splats only, on black."""
    return {name: TradeScene(name, *view.make()) for name, view in views.items()}


def digests(views: Views) -> dict[str, str]:
    """Digests of splats and camera of each view, by name, which identify its results."""
    clouds = {id(scene.cloud): scene.cloud for scene in views.values()}
    splats = {number: digest_of(cloud) for number, cloud in clouds.items()}
    return {name: digest_of((splats[id(scene.cloud)], scene.camera)) for name, scene in views.items()}
