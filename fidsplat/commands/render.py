"""`fidsplat render`."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import (
    Json,
    MemoryBudget,
    SceneDevice,
    bytes_of,
    check_words,
    console,
    late_progress,
    names_of,
    option,
    tell,
)
from fidsplat.effects.catalogue import outputs_help
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.files import path_of, writable_folder

if TYPE_CHECKING:
    from fidsplat.accuracy.choice import Choice
    from fidsplat.capture.quality import Quality
    from fidsplat.formats import Progress
    from fidsplat.render.frame import Frame
    from fidsplat.render.renderer import Renderer
    from fidsplat.scenes import Scene

_OTHER_PICTURES = (".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".exr", ".gif", ".npy")


@dataclass
class Render:
    """Draw a scene file or a bare splat file.

    A splat file without a scene is seen from -z, as large as fits a picture of 1280 x 720. OUT.png names the
    colour picture; other outputs stand beside it as OUT-depth.png and so on. Any other OUT is a folder for
    rgb.png, depth.png and so on. Depth comes as .npy (metres), .png (16-bit millimetres) and -turbo.png
    (colours); labels, ids and counts as .npy and .png (colours).

    Outputs:
    {outputs}

    Quality: standard fast reference gsplat surfel; any knob of fs.Quality may follow, or stand alone and
    change standard: fast,samples=2,alpha_cutoff=1e-3. Markers of a scene file that do not say how they are
    made take marker.mixture, marker.levels, marker.density, marker.growth and marker.template from it.

    Lenses, shutters and motion, fog, backgrounds, sensors and boxes are tables of a scene file
    (docs/scene-files.md); they go together.

    Examples:
      fidsplat render scene.toml
      fidsplat render scene.toml --quality standard,alpha_cutoff=1e-3,samples=2
      fidsplat render scene.toml -o frames --outputs rgb,depth,normal,label
      fidsplat render tag.ply -o tag.png --device reference --quality gsplat
      fidsplat render scene.toml --device reference --every 8      every 8th pixel, in a 64th of the time
      fidsplat render scene.toml --max-error 1e-3        measures first, and keeps what it found
      fidsplat render scene.toml --max-ms 20
    """

    source: Annotated[tyro.conf.Positional[str], option("SCENE.toml|FILE.ply|STORE.fss", "what to draw")]
    out: Annotated[
        str | None, option("OUT", "PNG file or folder (default: the source's name with .png, here)", "-o")
    ] = None
    outputs: Annotated[
        str | None,
        option("A,B,...", "output images, named above (default: the scene's, or rgb)"),
    ] = None
    device: SceneDevice = None
    quality: Annotated[
        str | None,
        option("Q", "a preset, knobs as key=value, or both, as below (default: the scene's, or standard)"),
    ] = None
    max_error: Annotated[
        float | None,
        option("E", "render with the cheapest quality whose error of rgb is certified to be at most E"),
    ] = None
    max_ms: Annotated[
        float | None,
        option("T", "draw with the most accurate quality that takes at most T milliseconds a frame"),
    ] = None
    every: Annotated[
        int | None,
        option("N", "of the reference: every Nth pixel in both directions, as a picture of those alone"),
    ] = None
    memory_budget: MemoryBudget = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.accuracy.quality_within import check_bounds
        from fidsplat.render.output_files import save_output

        names = names_of(self.outputs)
        check_words(names, self.quality)
        memory = bytes_of("--memory-budget", self.memory_budget)
        budget = self.max_error is not None or self.max_ms is not None
        if budget:
            check_bounds(self.max_error, self.max_ms)
        name_of = _names(self.out, path_of(self.source))
        where = console(self.json)
        with late_progress(console(True)) as progress:
            scene = load_source(self.source, self.quality, progress)
        with _named(self.source, "render.outputs", names is None):
            check_words(scene.outputs, None)
        of_scene = _named(self.source, "render.device", self.device is None and scene.device is not None)
        with where.status("opening the device"), of_scene:
            renderer = fs.Renderer(self.device or scene.device, memory)
        choice = self._measured(scene, renderer) if budget else None
        begun = time.perf_counter()
        frame = self._drawn(renderer, scene, names, self.quality if choice is None else choice.quality)
        images = {name: frame[name] for name in frame.outputs}
        seconds = time.perf_counter() - begun
        bits = None if scene.sensor is None else scene.sensor.bits
        files = [file for name, image in images.items() for file in save_output(name, image, name_of, bits)]
        facts = {
            "source": self.source,
            "device": renderer.device.name,
            "width": images[frame.outputs[0]].shape[1],
            "height": images[frame.outputs[0]].shape[0],
            "outputs": list(frame.outputs),
            "chosen": None if choice is None else choice.as_dict(),
            "stats": dict(frame.stats),
            "timings_ms": dict(frame.timings),
            "seconds": seconds,
            "files": [str(file) for file in files],
        }
        rows = [(stage, f"{ms:.2f} ms") for stage, ms in frame.timings.items()]
        rows += [(what, f"{count:,}") for what, count in frame.stats.items()]
        rows += [("with compilation and transfer", f"{seconds:.2f} s")]
        lines = [*(() if choice is None else (f"chosen: {choice.summary}",)), *facts["files"]]
        title = f"{self.source} on {renderer.device.title}"
        return tell(self.json, facts, *lines, table=(title, ("", ""), rows))

    def _measured(self, scene: "Scene", renderer: "Renderer") -> "Choice":
        """The quality that keeps to --max-error and --max-ms."""
        from fidsplat.accuracy.certification import certify
        from fidsplat.accuracy.quality_within import choose

        capture = scene.capture.with_(quality=self.quality)
        with console(self.json).status("measuring") as status:
            choice = choose(self.max_error, self.max_ms, scene, capture, renderer, report=status.update)
            if self.max_error is None:
                return choice
            return certify(choice, self.max_error, self.max_ms, scene, capture, renderer, status.update)

    def _drawn(
        self,
        renderer: "Renderer",
        scene: "Scene",
        names: tuple[str, ...] | None,
        quality: "Quality | str | None",
    ) -> "Frame":
        """The picture; the reference says how far it is."""
        if renderer.device.always_float64 or self.every is not None:
            with late_progress(console(True)) as progress:
                step = 1 if self.every is None else self.every
                return renderer.render_every(
                    step, scene, None, names, quality, lambda share: progress("drawing", share)
                )
        with console(self.json).status("drawing"):
            return renderer.render(scene, outputs=names, quality=quality)


Render.__doc__ = (Render.__doc__ or "").replace("    {outputs}", indent(outputs_help(), "    "))


@contextmanager
def _named(source: str, key: str, of_scene: bool) -> Iterator[None]:
    """Puts the scene file and its key before an error about what stands there, if that is what is used."""
    try:
        yield
    except FidsplatError as error:
        if of_scene and Path(source).suffix.lower() == ".toml":
            raise type(error)(f"{source}: {key}: {error}") from error
        raise


def _names(out: str | None, source: Path):
    """A function from an output's name and a suffix to the file that it goes to, in a folder known to be
    writable."""
    if not source.name:
        raise InputError(f"cannot draw {source}, a folder: give a scene file (.toml) or a splat file in it")
    if out == "":
        raise InputError("-o is empty; give a PNG file or a folder")
    file = path_of(out) if out is not None else Path(source.name).with_suffix(".png")
    if file.suffix.lower() in _OTHER_PICTURES:
        raise InputError(f"pictures are written as PNG: name {file.with_suffix('.png')}, or a folder")
    if file.suffix.lower() == ".png" and not file.is_dir():
        writable_folder(file.parent)
        return lambda name, suffix: file.with_name(
            f"{file.stem}{'' if name == 'rgb' else '-' + name}{suffix}"
        )
    writable_folder(file)
    return lambda name, suffix: file / f"{name}{suffix}"


def load_source(source: str, quality: str | None, progress: "Progress") -> "Scene":
    """A scene file, or a splat file as a scene of its own, seen by a camera that fits it.

    Raises:
        InputError: neither; a scene without a camera.
    """
    import fidsplat as fs
    from fidsplat.commands.framing import framing_camera
    from fidsplat.formats.files import FORMATS
    from fidsplat.store.layout import SUFFIX

    suffix = Path(source).suffix.lower()
    if suffix == ".toml":
        scene = fs.Scene.load(source, quality, progress)
        if scene.camera is None:
            raise InputError(
                f"{source} has no [camera] table; add one with width, height, fov_x_deg, position, look_at"
            )
        return scene
    if suffix == SUFFIX:
        store = fs.Store(source)
        return fs.Scene(stores=(store,), camera=framing_camera(store))
    if suffix in FORMATS:
        cloud = fs.load_splats(source, progress)
        return fs.Scene([cloud], camera=framing_camera(cloud))
    raise InputError(
        f"cannot draw {source}: give a scene file (.toml), a store ({SUFFIX}) or a splat file "
        f"({', '.join(FORMATS)})"
    )
