"""Demo: markers from text to splats, three rendered views, detection and comparison with ground truth."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.captured_demo import run_captured
from fidsplat.formats import save_ply
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.visualize import (
    colour_depth,
    colour_normals,
    contact_sheet,
    depth_key,
    depth_span,
    draw_outlines,
    normal_key,
)
from fidsplat.render.output_files import save_output
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.scenes.captured import fetch_scene
from fidsplat.util.files import writable_folder, write_json
from fidsplat.vision.readback import Reading, read_back
from fidsplat.worlds.yard import OUTPUTS, demo_scene, demo_views, sunlit

COMPLETE = 0.98
"""minimum visible share of a completely visible marker; the rest is the soft edge of its quiet zone"""
MAX_POSITION_ERROR = 0.01
"""maximum position error relative to the distance"""
_FRAMES = 3
"""timed frames after the one that compiles kernels"""


@dataclass(frozen=True, eq=False)
class Sighting:
    """A marker in a view."""

    view: str
    reading: Reading

    @property
    def passed(self) -> bool | None:
        """Whether the marker was found at its position; None for a marker that is not completely visible."""
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
    """by view: device time of a frame with all outputs, in milliseconds"""
    visible_splats: dict[str, int]
    """by view: number of splats after culling"""
    seconds: float
    """duration of the run in seconds"""
    files: list[Path]

    @property
    def passed(self) -> bool:
        """Whether all completely visible markers, at least one, were located, and nothing else."""
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
    """Run the demo and write its images, scene and results into the folder ``out``.

    Args:
        out: folder, created if missing; existing files are overwritten.
        device: name of a `Renderer`.
        progress: called with the name of each step.
        mixture: mixture of the markers; scene.ply has `fitted` instead of `exact`, since PLY files have no
            boxes.
        captured: name of a captured scene that is rendered with markers too, see `fetch_scene`.

    Raises InputError when the folder cannot be written or for an unknown mixture, DeviceError when the device
    cannot be used.
    """
    begun = time.perf_counter()
    folder = writable_folder(out)
    if captured is not None:
        progress(f"fetching the captured scene {captured}")
        fetch_scene(captured)  # first, since it may fail
    progress("making three markers and their scene")
    scene = sunlit(demo_scene(mixture=mixture))
    progress("opening the device")
    renderer = Renderer(device)
    files = [folder / "scene.toml", folder / "scene.ply"]
    scene.save(files[0])
    files += sorted(folder.glob("scene-splats-*.ply"))
    gaussians = scene if mixture != "exact" else sunlit(demo_scene(mixture="fitted"))
    save_ply(renderer.lit(gaussians).cloud(), files[1])
    # files round logarithms and logits to float32: render the splats of the file
    scene = Scene.load(files[0])
    resident = renderer.upload(scene)

    sightings, unexpected, frame_ms, visible, columns = [], [], {}, {}, {}
    for view, camera in demo_views().items():
        progress(f"rendering and detecting: {view}")
        images, frame_ms[view], visible[view] = _render(renderer, resident, scene, camera)
        readings, others = read_back(images, scene, camera)
        sightings += [Sighting(view, reading) for reading in readings]
        unexpected += [code.name for code in others]
        detected = [(r.detection.corners, r.placed.marker.spec) for r in readings if r.detection is not None]
        outlined = draw_outlines(to_uint8(images["rgb"]), detected)
        stem = folder / view.replace(" ", "-")
        for name, image in images.items():
            files += save_output(name, image, lambda kind, suffix, stem=stem: Path(f"{stem}-{kind}{suffix}"))
        files.append(write_png(f"{stem}-detection.png", outlined))
        columns[view] = (outlined, images["depth"], images["normal"])
    files.append(write_png(folder / "contact-sheet.png", _sheet(columns)))
    marker_splats = {p.marker.spec: len(p.marker.cloud) for p in scene.markers}
    if captured is not None:
        views, splats, image = run_captured(captured, renderer, folder, progress)
        files.append(image)
        marker_splats = splats | marker_splats
        for one in views:
            sightings += [Sighting(one.name, reading) for reading in one.readings]
            unexpected += one.others
            frame_ms[one.name], visible[one.name] = one.frame_ms, one.visible

    result = DemoResult(
        device=renderer.device.title,
        background_splats=sum(len(cloud) for cloud in scene.clouds),
        marker_splats=marker_splats,
        sightings=sightings,
        unexpected=unexpected,
        frame_ms=frame_ms,
        visible_splats=visible,
        seconds=time.perf_counter() - begun,
        files=[*files, folder / "demo.json"],
    )
    write_json(folder / "demo.json", result.as_dict(), indent=2)
    return result


def _render(
    renderer: Renderer, resident, scene: Scene, camera: Camera
) -> tuple[dict[str, np.ndarray], float, int]:
    """Output images, milliseconds of a warm frame, number of splats after culling."""
    times = []
    for _ in range(1 + _FRAMES):
        frame = renderer.render(resident, camera, outputs=OUTPUTS, background=scene.background)
        times.append(sum(frame.timings.values()))
    return {name: frame[name] for name in OUTPUTS}, float(np.median(times[1:])), int(frame.stats["visible"])


def _sheet(columns: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Contact sheet with a column per view: detections, depth and normals, with keys."""
    span = depth_span(depth for _, depth, _ in columns.values())
    rows = [
        [(f"{view}: what was read", outlined) for view, (outlined, _, _) in columns.items()],
        [(f"{view}: depth", colour_depth(depth, span)) for view, (_, depth, _) in columns.items()],
        [(f"{view}: normals", colour_normals(normal)) for view, (_, _, normal) in columns.items()],
    ]
    keys = (lambda height: None, lambda height: depth_key(span, height), normal_key)
    return contact_sheet(rows, width=560, key=lambda row, height: keys[row](height))
