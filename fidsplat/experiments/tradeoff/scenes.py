"""The scenes of `fidsplat tradeoff`: random ones, of 3D Gaussians too, the hard cases, markers at three
tilts, and one's own: splats from a file, seen from one's own cameras."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import MarkerQuality
from fidsplat.experiments.bench.catalogue import BenchScene
from fidsplat.experiments.setup import BACKGROUND, CATEGORIES, PROTOCOLS
from fidsplat.experiments.tradeoff.hard import hard_scene
from fidsplat.markers import Marker, marker
from fidsplat.scenes.random_clouds import load_scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.provenance import digest_of

RANDOM = ("r100k_720p", "r1m_1080p")
THICK = ("r100k_720p_3d", "r1m_1080p_3d")
"""scenes of 3D Gaussians, which show what the ways of drawing them cost"""
HARD = "hard"
MARKERS = {"apriltag": "apriltag", "qr2": "small", "qr5": "medium", "qr10": "large", "qr22": "huge"}
"""name -> the category of the paper that marker 0 is taken of"""
FEW_KNOBS = ("apriltag", "qr2", "qr5", "qr22")
"""markers that show how they are made; what every other knob does to markers qr10 shows"""
NAMES = (*RANDOM, *THICK, HARD, *MARKERS)
QUICK_NAMES = ("r100k_720p", HARD, "apriltag", "qr10")
TILTS = (0, 60, 80)
"""degrees from the marker's normal"""
PROTOCOL = PROTOCOLS["fixed-plane"]
"""how markers are looked at: a plane of 2 x 2 m, 4 m away, in 800 x 800 pixels"""
GREY = (BACKGROUND, BACKGROUND, BACKGROUND)
"""beside the plane of a marker"""
SEED = 0


@dataclass(frozen=True, eq=False)
class TradeScene:
    """One picture to be drawn."""

    name: str
    """`qr10@60` is the marker qr10 at 60 degrees"""
    cloud: SplatCloud
    camera: Camera
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    made: Marker | None = None
    """the marker, in modules of `PROTOCOL`"""

    @cached_property
    def capture(self) -> Capture:
        """How it is taken."""
        return Capture(self.camera, background=self.background)


def scene_names(words: Iterable[str], quick: bool = False) -> tuple[str, ...]:
    """Names of scenes from words, each once; none: all of them, or those of a quick run.

    Raises:
        InputError: a name that no scene has.
    """
    names = tuple(dict.fromkeys(words)) or (QUICK_NAMES if quick else NAMES)
    for name in names:
        if name not in NAMES:
            raise InputError(unknown("scene", name, NAMES))
    return names


def views_of(name: str) -> tuple[str, ...]:
    """The pictures that belong to a scene's name: itself, or a marker at each tilt."""
    return tuple(f"{name}@{tilt}" for tilt in TILTS) if name in MARKERS else (name,)


def is_marker(view: str) -> bool:
    """Whether a picture or a scene's name is of a marker."""
    return view.partition("@")[0] in MARKERS


def make(view: str, knobs: MarkerQuality) -> TradeScene:
    """A picture of `views_of`; knobs: how its marker becomes splats.

    Raises:
        InputError: there is no such mixture or template.
    """
    name, _, tilt = view.partition("@")
    if name in MARKERS:
        made = made_marker(name, knobs)
        return TradeScene(view, made.cloud, PROTOCOL.camera(float(tilt)), GREY, made)
    cloud, camera = hard_scene(SEED) if name == HARD else load_scene(name, SEED)
    return TradeScene(view, cloud, camera)


@lru_cache(maxsize=32)
def made_marker(name: str, knobs: MarkerQuality) -> Marker:
    """The marker of that name on its plane of 2 x 2 m, quiet zone included."""
    spec = CATEGORIES[MARKERS[name]].spec(0, SEED)
    plain = marker(spec)
    module = PROTOCOL.module(plain.grid.shape[0])
    return marker(spec, module * plain.bits.shape[1], quality=knobs)


Own = Mapping[str, TradeScene]
"""one's own pictures, by the names of their views"""


def own_pictures(views: Mapping[str, BenchScene]) -> dict[str, TradeScene]:
    """The pictures of `fidsplat bench`'s own scenes: splats alone, on black."""
    return {name: TradeScene(name, *view.make()) for name, view in views.items()}


def digests(own: Own) -> dict[str, str]:
    """16 hexadecimal digits of each picture's splats and camera, by its name: results are of these alone."""
    clouds = {id(scene.cloud): scene.cloud for scene in own.values()}
    splats = {number: digest_of(cloud) for number, cloud in clouds.items()}
    return {name: digest_of((splats[id(scene.cloud)], scene.camera)) for name, scene in own.items()}
