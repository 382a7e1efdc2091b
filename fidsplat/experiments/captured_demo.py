"""Second part of the demo: an AprilTag and a QR code in a captured scene, rendered and detected."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.files import load_splats
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.visualize import contact_sheet, draw_outlines
from fidsplat.markers import marker
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.captured import captured_scenes, fetch_scene
from fidsplat.scenes.lights import Lighting
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision.readback import Reading, read_back

_WIDTH, _HEIGHT, _FOV_X = 800, 450, math.radians(50.0)
_ANGLES = (-10.0, 30.0)
"""degrees of the views about the vertical, from the front"""


@dataclass(frozen=True)
class _Layout:
    """Positions of markers and cameras in a captured scene [m], y down."""

    tag: tuple[float, float, float]
    code: tuple[float, float, float]
    size: float
    target: tuple[float, float, float]
    distance: float
    background: tuple[float, float, float]
    ambient: tuple[float, float, float]
    """light of the studio, which the background does not show"""


_LAYOUTS = {
    "biker": _Layout(
        (0.75, -1.3, -0.2),
        (-1.15, -1.3, -0.2),
        0.6,
        (-0.15, -1.6, 0),
        7.0,
        (0.72, 0.74, 0.76),
        (0.6, 0.61, 0.63),
    ),
    "playbot": _Layout(
        (0.6, -0.2, -0.55),
        (-0.6, -0.2, -0.55),
        0.24,
        (0, -0.45, -0.1),
        3.0,
        (0.16, 0.17, 0.2),
        (0.45, 0.45, 0.5),
    ),
}


def captured_scene(name: str, progress: Callable[[str, float], None] = lambda *_: None) -> Scene:
    """A captured scene with an AprilTag and a QR code. Raises InputError as `fetch_scene`."""
    path, layout = fetch_scene(name, progress), _LAYOUTS[name]
    specs = (("apriltag:36h11:5", layout.tag), ("qr:fidsplat", layout.code))
    placed = tuple(
        PlacedMarker(
            marker(spec, size=layout.size),
            rigid_matrix(place),
            light=Lighting(ambient=layout.ambient, rows=16, panoramas=2),
        )
        for spec, place in specs
    )
    return Scene((load_splats(path),), markers=placed, background=layout.background)


def captured_views(name: str) -> dict[str, Camera]:
    """Cameras on a circle around the front of a captured scene, slightly above."""
    layout, views = _LAYOUTS[name], {}
    for degrees in _ANGLES:
        turn = math.radians(degrees)
        away = layout.distance * np.array([math.sin(turn), -0.12, -math.cos(turn)])
        position = np.array(layout.target) + away
        views[f"{degrees:+.0f} degrees"] = Camera.look_at(_WIDTH, _HEIGHT, _FOV_X, position, layout.target)
    return views


@dataclass(frozen=True, eq=False)
class CapturedView:
    """A rendered view of a captured scene."""

    name: str
    readings: list[Reading]
    others: list[str]
    """names of detected codes that are not in the scene"""
    frame_ms: float
    visible: int
    """splats after culling"""


def run_captured(
    name: str, renderer: Renderer, folder: Path, progress: Callable[[str], None] = lambda _: None
) -> tuple[list[CapturedView], dict[str, int], Path]:
    """Render and detect the markers of a captured scene; returns its views, the splats of each marker, and
    the written image."""
    progress(f"reading the captured scene {name}")
    scene, views, row = captured_scene(name), [], []
    resident = renderer.upload(scene)
    for view, camera in captured_views(name).items():
        progress(f"rendering and detecting: {name}, {view}")
        frame = [renderer.render(resident, camera, background=scene.background) for _ in range(2)][-1]
        readings, others = read_back(frame["rgb"], scene, camera)
        found = [(r.detection.corners, r.placed.marker.spec) for r in readings if r.detection is not None]
        row.append((f"{captured_scenes()[name].title}, {view}", draw_outlines(to_uint8(frame["rgb"]), found)))
        milliseconds, visible = sum(frame.timings.values()), int(frame.stats["visible"])
        names = [code.name for code in others]
        views.append(CapturedView(f"{name}, {view}", readings, names, milliseconds, visible))
    splats = {placed.marker.spec: len(placed.marker.cloud) for placed in scene.markers}
    return views, splats, write_png(folder / f"{name}.png", contact_sheet([row], width=_WIDTH))
