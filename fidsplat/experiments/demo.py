"""Demo: make markers, render three views, detect the markers and compare them with ground truth; also for an
AprilTag and a QR code in a captured scene."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats import save_ply
from fidsplat.formats.files import load_splats
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.visualize import (
    color_depth,
    color_normals,
    contact_sheet,
    depth_key,
    depth_span,
    draw_outlines,
    normal_key,
)
from fidsplat.markers import marker
from fidsplat.render.output_files import save_output
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.captured import captured_scenes, fetch_in_background, fetch_scene
from fidsplat.scenes.lights import Lighting
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.files import writable_folder, write_json
from fidsplat.vision.readback import Reading, read_back
from fidsplat.worlds.yard import OUTPUTS, demo_scene, demo_views, sunlit

COMPLETE = 0.98
"""visible fraction above which a marker counts as completely visible: its quiet zone has soft edges"""
MAX_POSITION_ERROR = 0.01
"""maximum position error relative to the distance"""
_FRAMES = 3
"""number of timed frames after the frame that compiles kernels"""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Readout of a marker in a view."""

    view: str
    reading: Reading

    @property
    def passed(self) -> bool | None:
        """Whether the marker was located; None for a marker that is not completely visible."""
        if self.reading.visible < COMPLETE:
            return None
        error = self.reading.position_error
        return error is not None and error < MAX_POSITION_ERROR * self.reading.distance


@dataclass(frozen=True, eq=False)
class DemoResult:
    """Results of the demo."""

    device: str
    background_splats: int
    marker_splats: dict[str, int]
    sightings: list[Sighting]
    unexpected: list[str]
    """detected codes that are not in the scene"""
    frame_ms: dict[str, float]
    """device time of a frame with all outputs by view, in milliseconds"""
    visible_splats: dict[str, int]
    """number of splats after culling by view"""
    captured: str
    """title, author and licence of the captured scene, or the reason why it is missing"""
    seconds: float
    """duration of the run in seconds"""
    files: list[Path]

    @property
    def passed(self) -> bool:
        """Whether all completely visible markers were located, at least one, and no other code was found."""
        decided = [s.passed for s in self.sightings if s.passed is not None]
        return bool(decided) and all(decided) and not self.unexpected

    def as_dict(self) -> dict:
        """Plain data for JSON."""
        sightings = [{"view": s.view, "passed": s.passed, **s.reading.as_dict()} for s in self.sightings]
        return (
            {"passed": self.passed} | vars(self) | {"sightings": sightings, "files": [*map(str, self.files)]}
        )


def run_demo(
    out: str | Path,
    device: str | None = None,
    progress: Callable[[str], None] = lambda text: None,
    mixture: str = "exact",
    captured: str | None = None,
) -> DemoResult:
    """Run the demo; writes its images, scene and results into the folder ``out``.

    Args:
        out: folder, created if missing; existing files are overwritten.
        device: name of a `Renderer`.
        progress: called with the name of each step.
        mixture: mixture of the markers; scene.ply has `fitted` instead of `exact`, since PLY files have no
            boxes.
        captured: name of a captured scene (`fetch_scene`) that is rendered with markers too, or "none". By
            default biker, if its download ends while the other views are rendered.

    Raises InputError if the folder cannot be written or the mixture is unknown, DeviceError if the device
    cannot be used.
    """
    begun = time.perf_counter()
    folder = writable_folder(out)
    name = "biker" if captured is None else captured
    missing = fetch_in_background(name) if captured is None else None
    if captured not in (None, "none"):
        progress(f"fetching the captured scene {captured}")
        fetch_scene(captured)  # before other work, since it may fail
    progress("making three markers and their scene")
    scene = sunlit(demo_scene(mixture=mixture))
    progress("opening the device")
    renderer = Renderer(device)
    files = [folder / "scene.toml", folder / "scene.ply"]
    scene.save(files[0])
    files += sorted(folder.glob("scene-splats-*.ply"))
    gaussians = scene if mixture != "exact" else sunlit(demo_scene(mixture="fitted"))
    save_ply(renderer.lit(gaussians).cloud(), files[1])
    # files round logarithms and logits to float32: render the file's splats
    scene = Scene.load(files[0])
    resident = renderer.upload(scene)

    views = []
    for title, camera in demo_views().items():
        progress(f"rendering and detecting: {title}")
        view = render_view(renderer, resident, scene, title, camera)
        views.append(view)
        stem = folder / title.replace(" ", "-")
        for output, image in view.images.items():
            files += save_output(output, image, lambda kind, end, stem=stem: Path(f"{stem}-{kind}{end}"))
        files.append(write_png(f"{stem}-detection.png", view.outlined))
    files.append(write_png(folder / "contact-sheet.png", _sheet(views)))
    marker_splats = {placed.marker.spec: len(placed.marker.cloud) for placed in scene.markers}
    reason = missing() if missing else "not requested" if captured == "none" else ""
    if not reason:
        # light from panoramas would take 3 s in the first run
        shown, splats = run_captured(name, renderer, "lights" if captured is None else "scene", progress)
        views += shown
        marker_splats = splats | marker_splats
        row = [(view.name, view.outlined) for view in shown]
        files.append(write_png(folder / f"{name}.png", contact_sheet([row], width=_WIDTH)))

    result = DemoResult(
        device=renderer.device.title,
        background_splats=sum(len(cloud) for cloud in scene.clouds),
        marker_splats=marker_splats,
        sightings=[Sighting(view.name, reading) for view in views for reading in view.readings],
        unexpected=[name for view in views for name in view.others],
        frame_ms={view.name: view.frame_ms for view in views},
        visible_splats={view.name: view.visible for view in views},
        captured=reason or captured_scenes()[name].credit,
        seconds=time.perf_counter() - begun,
        files=[*files, folder / "demo.json"],
    )
    write_json(folder / "demo.json", result.as_dict(), indent=2)
    return result


@dataclass(frozen=True, eq=False)
class DemoView:
    """Rendered view with the detected markers."""

    name: str
    images: dict[str, np.ndarray]
    """output images by name"""
    outlined: np.ndarray
    """(h, w, 3) uint8 image with the outlines of detected markers"""
    readings: list[Reading]
    others: list[str]
    """names of detected codes that are not in the scene"""
    frame_ms: float
    """device time of a warm frame in milliseconds"""
    visible: int
    """number of splats after culling"""


def render_view(
    renderer: Renderer, resident: Any, scene: Scene, name: str, camera: Camera, outputs: Any = OUTPUTS
) -> DemoView:
    """Render a view, detect its markers, and time warm frames."""
    frame, frame_ms = _render(renderer, resident, scene, camera, outputs)
    images = {output: frame[output] for output in frame.outputs}
    readings, others = read_back(images, scene, camera)
    detected = [(r.detection.corners, r.placed.marker.spec) for r in readings if r.detection is not None]
    outlined = draw_outlines(to_uint8(images["rgb"]), detected)
    names, visible = [code.name for code in others], int(frame.stats["visible"])
    return DemoView(name, images, outlined, readings, names, frame_ms, visible)


def _render(
    renderer: Renderer, resident: Any, scene: Scene, camera: Camera, outputs: Any
) -> tuple[Any, float]:
    """A frame, and the median device time of warm frames in milliseconds."""
    times = []
    for _ in range(1 + _FRAMES):
        frame = renderer.render(resident, camera, outputs=outputs, background=scene.background)
        times.append(sum(frame.timings.values()))
    return frame, float(np.median(times[1:]))


def _sheet(views: list[DemoView]) -> np.ndarray:
    """Contact sheet with one column per view: detections, depth and normals, with colour keys."""
    span = depth_span(view.images["depth"] for view in views)
    rows = [
        [(f"{view.name}: what was read", view.outlined) for view in views],
        [(f"{view.name}: depth", color_depth(view.images["depth"], span)) for view in views],
        [(f"{view.name}: normals", color_normals(view.images["normal"])) for view in views],
    ]
    keys = (lambda height: None, lambda height: depth_key(span, height), normal_key)
    return contact_sheet(rows, width=560, key=lambda row, height: keys[row](height))


_WIDTH, _HEIGHT, _FOV_X = 800, 450, math.radians(50.0)
_ANGLES = (-10.0, 30.0)
"""azimuths of the views in degrees, relative to the front"""


@dataclass(frozen=True)
class _Layout:
    """Positions of markers and cameras in a captured scene in metres, y down."""

    tag: tuple[float, float, float]
    code: tuple[float, float, float]
    size: float
    target: tuple[float, float, float]
    distance: float
    background: tuple[float, float, float]
    ambient: tuple[float, float, float]
    """ambient light of the studio, which is not visible in the background"""


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


def captured_scene(name: str, light: str) -> Scene:
    """Captured scene with an AprilTag and a QR code. light: a value of `Lighting.source`. Raises InputError
    as `fetch_scene`."""
    path, layout = fetch_scene(name), _LAYOUTS[name]
    specs = (("apriltag:36h11:5", layout.tag), ("qr:fidsplat", layout.code))
    placed = tuple(
        PlacedMarker(
            marker(spec, size=layout.size),
            rigid_matrix(place),
            light=Lighting(light, ambient=layout.ambient, rows=16, panoramas=2),
        )
        for spec, place in specs
    )
    return Scene((load_splats(path),), markers=placed, background=layout.background)


def captured_views(name: str) -> dict[str, Camera]:
    """Cameras on an arc in front of a captured scene, slightly above it."""
    layout, views = _LAYOUTS[name], {}
    for degrees in _ANGLES:
        azimuth = math.radians(degrees)
        offset = layout.distance * np.array([math.sin(azimuth), -0.12, -math.cos(azimuth)])
        position = np.array(layout.target) + offset
        views[f"{degrees:+.0f} degrees"] = Camera.look_at(_WIDTH, _HEIGHT, _FOV_X, position, layout.target)
    return views


def run_captured(
    name: str, renderer: Renderer, light: str, progress: Callable[[str], None] = lambda _: None
) -> tuple[list[DemoView], dict[str, int]]:
    """Render and detect the markers of a captured scene; returns its views and the marker's splat counts."""
    progress(f"reading the captured scene {name}")
    scene, title, views = captured_scene(name, light), captured_scenes()[name].title, []
    resident = renderer.upload(scene)
    for view, camera in captured_views(name).items():
        progress(f"rendering and detecting: {name}, {view}")
        views.append(render_view(renderer, resident, scene, f"{title}, {view}", camera, ("rgb",)))
    return views, {placed.marker.spec: len(placed.marker.cloud) for placed in scene.markers}
