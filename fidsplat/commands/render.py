"""Commands `fidsplat render` and `fidsplat gallery`: render scenes to images."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING

import tyro

from fidsplat.commands.options import Device, Json, check_request
from fidsplat.commands.output import console, delayed_progress, report, steps_shown
from fidsplat.commands.scenes import RenderInput, Size
from fidsplat.effects.extensions import outputs_help
from fidsplat.scenes.sources import StartPose
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.files import path_of, writable_folder

if TYPE_CHECKING:
    import numpy as np

    from fidsplat.accuracy.candidates import Choice
    from fidsplat.capture.quality import Quality
    from fidsplat.render.frame import Frame
    from fidsplat.render.renderer import Renderer
    from fidsplat.scenes import Scene

_OTHER_IMAGES = (".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".exr", ".gif", ".npy")


@dataclass
class Render(RenderInput):
    """Render a scene file, a splat file or a store (a folder .fss with splats on disk) to images.

    A splat file has no camera: the default camera frames all of it, with the up axis that `fidsplat info`
    guesses. --up, --position, --look-at and --size set the camera of any scene. With -o OUT.png the colour
    image is OUT.png and other outputs are OUT-depth.png and so on. Any other OUT is a folder for rgb.png,
    depth.png and so on. Depth is written as .npy (metres), .png (16-bit millimetres) and -turbo.png
    (colours), labels, ids and counts as .npy and .png (colours).

    Outputs:
    {outputs}

    Quality: standard, fast, reference, gsplat or surfel, then settings of fs.Quality as key=value; settings
    without a preset change standard: fast,samples=2,alpha_cutoff=1e-3. On NVIDIA's GPUs through OpenCL,
    arithmetic=approximate and blend_precision=float16 save time, and add errors of up to 1e-6 and 0.01.
    For markers of a scene file without their own settings, the quality's marker.mixture, marker.levels,
    marker.density, marker.growth and marker.template apply.

    Lenses, shutters and motion, fog, backgrounds and sensors are tables of a scene file
    (docs/scene-files.md) and can be combined.

    --depth-camera writes the measured depth of a device at the camera's position, with its own field of view,
    errors and holes, as NAME.npy, NAME.png and NAME-turbo.png.

    Examples:
      fidsplat render scene.toml
      fidsplat render scene.toml --quality standard,alpha_cutoff=1e-3,samples=2
      fidsplat render scene.toml -o frames --outputs rgb,depth,normal,label
      fidsplat render room.ply --up 0 0 1 --position -2 0 1.5 --look-at 0 0 1 --size 1920 1080
      fidsplat render tag.ply -o tag.png --device reference --quality gsplat
      fidsplat render scene.toml --device reference --every 8      every 8th pixel, in a 64th of the time
      fidsplat render scene.toml --max-error 1e-3        measures qualities first and caches the result
      fidsplat render scene.toml --max-ms 20
    """

    out: str | None = None
    """OUT: PNG file or folder (default: the source's name with .png, in the current folder)"""
    max_error: float | None = None
    """E: use the fastest quality whose error of rgb is certified to be at most E"""
    max_ms: float | None = None
    """T: use the most accurate quality that takes at most T milliseconds per frame"""
    every: int | None = None
    """N: render every Nth pixel in both directions as a smaller image (device reference only)"""
    depth_camera: str | None = None
    """NAME: also write the depth of a depth camera: d435, azure-kinect or kinect-v1"""
    pose: StartPose = field(default_factory=StartPose)
    size: Size = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.accuracy.quality_within import check_bounds
        from fidsplat.render.output_files import save_output

        self.check()
        bounded = self.max_error is not None or self.max_ms is not None
        if bounded:
            with _option_names():
                check_bounds(self.max_error, self.max_ms)
        name_of = _file_names(self.out, path_of(self.source))
        scene = self.load(self.pose, self.size)
        with _scene_key(self.source, "render.outputs", self.outputs is None):
            check_request(scene.outputs, None)
        named = _scene_key(self.source, "render.device", self.device is None and scene.device is not None)
        with console(self.json).status("opening the device"), named:
            renderer = fs.Renderer(self.device or scene.device, self.memory_budget)
        choice = self._choose_quality(scene, renderer) if bounded else None
        begun = time.perf_counter()
        frame = self._render(renderer, scene, self.quality if choice is None else choice.quality)
        images = {name: frame[name] for name in frame.outputs}
        seconds = time.perf_counter() - begun
        measured = {} if self.depth_camera is None else {self.depth_camera: self._measured(renderer, scene)}
        bits = None if scene.sensor is None else scene.sensor.bits
        files = [str(file) for name in images for file in save_output(name, images[name], name_of, bits)]
        for name, depth in measured.items():
            files += [str(file) for file in save_output("depth", depth, lambda _, s, n=name: name_of(n, s))]
        height, width = images[frame.outputs[0]].shape[:2]
        facts = {
            "source": self.source,
            "device": renderer.device.name,
            "width": width,
            "height": height,
            "outputs": list(frame.outputs),
            "chosen": None if choice is None else choice.as_dict(),
            "stats": dict(frame.stats),
            "timings_ms": dict(frame.timings),
            "seconds": seconds,
            "files": files,
        }
        rows = [(stage, f"{ms:.2f} ms") for stage, ms in frame.timings.items()]
        rows += [(what, f"{count:,}") for what, count in frame.stats.items()]
        rows += [("with compilation and transfer", f"{seconds:.2f} s")]
        lines = [*(() if choice is None else (f"chosen: {choice.summary}",)), *files]
        title = f"{self.source} on {renderer.device.title}"
        return report(self.json, facts, *lines, table=(title, ("", ""), rows))

    def _measured(self, renderer: Renderer, scene: Scene) -> np.ndarray:
        """Depth image of the depth camera at the scene's camera."""
        from fidsplat.sim.depth_cameras import depth_camera

        assert scene.camera is not None
        assert self.depth_camera is not None
        camera = scene.capture.motion.moved(scene.camera, scene.capture.shutter.time)
        device, pinhole = depth_camera(self.depth_camera, world_to_camera=camera.world_to_camera)
        return device.measure(renderer, scene, pinhole)

    def _choose_quality(self, scene: Scene, renderer: Renderer) -> Choice:
        """The quality within --max-error and --max-ms."""
        from fidsplat.accuracy.certification import certify
        from fidsplat.accuracy.quality_within import choose

        capture = scene.capture.with_(quality=self.quality)
        with steps_shown(console(self.json), "measuring") as update, _option_names():
            choice = choose(self.max_error, self.max_ms, scene, capture, renderer, report=update)
            if self.max_error is None:
                return choice
            return certify(choice, self.max_error, self.max_ms, scene, capture, renderer, update)

    def _render(self, renderer: Renderer, scene: Scene, quality: Quality | str | None) -> Frame:
        """The frame; the slow reference device shows its progress."""
        if self.every is not None and not renderer.device.always_float64:
            raise InputError(f"--every must be given with --device reference, got {renderer.device.name}")
        if renderer.device.always_float64:
            with delayed_progress() as progress:
                step = 1 if self.every is None else self.every
                return renderer.render_subsampled(
                    step, scene, None, self.outputs, quality, lambda fraction: progress("rendering", fraction)
                )
        with console(self.json).status("rendering"):
            return renderer.render(scene, outputs=self.outputs, quality=quality)


Render.__doc__ = (Render.__doc__ or "").replace("    {outputs}", indent(outputs_help(), "    "))


@contextmanager
def _scene_key(source: str, key: str, from_scene: bool) -> Iterator[None]:
    """Prefix errors with the scene file and the key if the value is from the scene file."""
    try:
        yield
    except FidsplatError as error:
        if from_scene and Path(source).suffix.lower() == ".toml":
            raise type(error)(f"{source}: {key}: {error}") from error
        raise


@contextmanager
def _option_names() -> Iterator[None]:
    """Name the options in errors about the bounds `error` and `ms`."""
    try:
        yield
    except InputError as error:
        text = re.sub(r"^(error|ms) must", r"--max-\1 must", str(error))
        raise InputError(re.sub(r"try (error|ms)=", r"try --max-\1 ", text)) from error


def _file_names(out: str | None, source: Path) -> Callable[[str, str], Path]:
    """Function that returns the file of an output name and a suffix, in a writable folder."""
    if not source.name:
        raise InputError(f"the source must be a scene file (.toml) or a splat file, got the folder {source}")
    if out == "":
        raise InputError("-o must be a PNG file or a folder, got ''")
    file = path_of(out) if out is not None else Path(source.name).with_suffix(".png")
    if file.suffix.lower() in _OTHER_IMAGES:
        raise InputError(
            f"-o must be a PNG file or a folder, got {file}; name {file.with_suffix('.png')} or a folder"
        )
    if file.suffix.lower() == ".png" and not file.is_dir():
        writable_folder(file.parent)
        return lambda name, suffix: file.with_name(
            f"{file.stem}{'' if name == 'rgb' else '-' + name}{suffix}"
        )
    writable_folder(file)
    return lambda name, suffix: file / f"{name}{suffix}"


@dataclass
class Gallery:
    """Render scenes and make a web page of their images.

    DIR/index.html shows every scene with its outputs, its splats and its scene file, and needs only the
    images next to it. Unchanged scenes are not rendered again.

    Examples:
      fidsplat gallery examples/*.toml
      fidsplat gallery fidsplat-demo/scene.toml room.ply -o images --device opencl:nvidia
    """

    sources: tyro.conf.Positional[tuple[str, ...]]
    """SCENE.toml|FILE.ply...: scenes"""
    out: str = "fidsplat-gallery"
    """DIR: folder"""
    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.render.gallery import gallery_scene, write_gallery
        from fidsplat.scenes.sources import load_source

        if not self.sources:
            raise InputError(
                "scenes must be at least one scene file (.toml) or splat file, got none; give e.g. "
                "examples/*.toml"
            )
        with delayed_progress() as progress:
            total, scenes = len(self.sources), []
            for k, source in enumerate(self.sources):
                progress(f"reading {source}", 0.5 * k / total)
                scenes.append(gallery_scene(path_of(source), load_source(source)))
            files: list[Path] = []
            for file in write_gallery(path_of(self.out), scenes, self.device):
                files.append(file)
                progress(file.name, 0.5 + 0.5 * len(files) / (total + 1))
        page = str(files[-1])
        facts = {"page": page, "pictures": [str(file) for file in files[:-1]]}
        return report(self.json, facts, f"{total} scenes in {page}")
