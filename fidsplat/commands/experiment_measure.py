"""`fidsplat experiment`: the experiments that measure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from fidsplat.commands.experiment_files import CATEGORY_HELP, Names, write_report
from fidsplat.commands.output import Json, console, option, print_json
from fidsplat.errors import InputError

if TYPE_CHECKING:
    from fidsplat.experiments.run import Settings


@dataclass
class Basic:
    """Options of every word that works on markers."""

    out: Annotated[
        str | None,
        option(
            "DIR",
            "folder for results (default: fidsplat-experiments, with --quick fidsplat-experiments-quick)",
            "-o",
        ),
    ] = None
    category: Annotated[Names, option("NAME", CATEGORY_HELP)] = ()
    seed: Annotated[int, option("N", "of texts and views (default: 0)")] = 0
    json: Json = False

    def settings(self) -> Settings:
        """The options as the experiments take them; those that a word does not have are left out."""
        from fidsplat.experiments.run import Settings

        given = {name: getattr(self, name) for name in _SETTINGS if getattr(self, name, None) is not None}
        out = Path(self.out or default_folder(getattr(self, "quick", False)))
        return Settings(out=out, **{_SETTINGS[name]: value for name, value in given.items()})


# option: what it is called in Settings
_SETTINGS = {
    "category": "categories",
    "mixture": "mixtures",
    "protocol": "protocols",
    "shard": "part",
    "ideal": "ideal_only",
} | {
    name: name
    for name in (
        "device",
        "quick",
        "seed",
        "tilts",
        "markers",
        "trained",
        "blender",
        "lpips",
        "workers",
        "anew",
    )
}


@dataclass
class Measuring(Basic):
    """Options of the experiments that measure."""

    quick: Annotated[
        bool,
        tyro.conf.arg(help="a rough picture in minutes: one marker of each category", help_behavior_hint=""),
    ] = False
    markers: Annotated[int | None, option("N", "of each category, 1 to 5 (default: 5, with --quick 1)")] = (
        None
    )
    shard: Annotated[str | None, option("i/n", "measure the i-th of n shares, then see `merge`")] = None
    anew: Annotated[
        bool, tyro.conf.arg(help="measure again what is in the results' folder", help_behavior_hint="")
    ] = False


@dataclass
class Drawn:
    """Options of what draws splats."""

    device: Annotated[str, option("D", "see `fidsplat devices` (default: opencl)")] = "opencl"
    mixture: Annotated[Names, option("NAME", "mixture of Gaussians, once more for each (default: all)")] = ()
    trained: Annotated[
        Path | None, option("DIR", "trained models for the 2DGS columns, as 2dgs-17/small-0.ply")
    ] = None


@dataclass
class Threaded(Drawn, Measuring):
    """Options of experiments that look at pictures in several threads."""

    workers: Annotated[
        int | None, option("N", "threads that look at pictures (default: one for each core)")
    ] = None


@dataclass
class Compared(Threaded):
    """Options of experiments that compare pictures."""

    blender: Annotated[
        Path | None, option("DIR", "Blender's pictures for `views` (default: blender in the results' folder)")
    ] = None
    lpips: Annotated[
        Path | None,
        option("FILE.npz", "weights for LPIPS in `views`; how to make the file: docs/ground-truth.md"),
    ] = None


def default_folder(quick: bool) -> str:
    """Where results go without -o: rough ones and full ones do not mix."""
    return "fidsplat-experiments" + ("-quick" if quick else "")


def measure(names: tuple[str, ...], settings: Settings, as_json: bool) -> int:
    """Run experiments with a progress bar, each to its file, and say where."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    from fidsplat.experiments.run import planned

    files: dict[str, str] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    columns = (*columns, TimeElapsedColumn(), Remaining())
    with planned(names, settings) as plans:
        for name, plan in plans.items():
            with Progress(*columns, console=console(True)) as bars:
                bar = bars.add_task(name, total=len(plan.work), completed=len(plan.work) - plan.left)
                for done, line in plan.run():
                    bars.update(bar, completed=done, description=f"{name} {_what(line['key'])}")
                bars.update(bar, description=name)
            if plan.work:
                files[name] = str(plan.records.file)
    if as_json:
        print_json({"files": files})
    else:
        for file in files.values():
            console(False).print(file, markup=False, soft_wrap=True)
    return 0


def _what(key: dict) -> str:
    words = (key.get("protocol"), f"{key['category']}-{key['index']}", key.get("method"), key.get("truth"))
    return " ".join(word for word in words if word)


@dataclass
class Angles(Threaded):
    """Table 3: how far markers may tilt and still be found and read."""

    HELP: ClassVar[str] = """The largest tilt at which each detector finds and reads each marker (table 3).

Every tilt from 0 to 89.8 degrees in steps of 0.2 is drawn and shown to every detector: for tags OpenCV's
aruco and the AprilTag library (if pupil-apriltags is installed), for QR codes OpenCV's, zxing-cpp, and
zxing-cpp after the picture was made taller. Protocols: fixed-plane (2 x 2 plane, 800 x 800) and fixed-module
(8 px a module, 1600 x 1600). A run that was stopped goes on where it was.

Examples:
  fidsplat experiment angles --quick
  fidsplat experiment angles --ideal                     only the detectors' ceiling; no device needed
  fidsplat experiment angles --protocol fixed-plane --category small --tilts 60:89.8:0.2
  fidsplat experiment angles --shard 1/4 --device opencl:nvidia"""

    protocol: Annotated[Names, option("NAME", "fixed-plane or fixed-module (default: both)")] = ()
    tilts: Annotated[str | None, option("A:B:STEP", "degrees, joined by commas (default: 0:89.8:0.2)")] = None
    ideal: Annotated[
        bool,
        tyro.conf.arg(help="only the ideal texture: the ceiling of the detectors", help_behavior_hint=""),
    ] = False

    def run(self) -> int:
        return measure(("angles",), self.settings(), self.json)


@dataclass
class Views(Compared):
    """Table 4: PSNR, SSIM, FLIP and LPIPS of 20 novel views."""

    HELP: ClassVar[str] = """PSNR, SSIM, FLIP and LPIPS of 20 random views of each marker (table 4).

Ground truth: the exact renderer (a pixel is the mean of its square), the same with means of linear light,
and Blender's pictures where `fidsplat experiment blender` has made them. FLIP needs flip-evaluator, LPIPS
weights. A run that was stopped goes on where it was.

Examples:
  fidsplat experiment views --quick
  fidsplat experiment views --category huge --mixture fitted
  fidsplat experiment views --blender pictures/blender"""

    def run(self) -> int:
        return measure(("views",), self.settings(), self.json)


@dataclass
class Counts(Measuring):
    """Table 2 and the figure: components, rectangles, Gaussians, seconds."""

    HELP: ClassVar[str] = """Components, rectangles, Gaussians and seconds of each marker (table 2, figure).

Squares of modules, runs of rows and the minimum partition, for every mixture. The time is that from the
text to the splats in a process that has made the marker before; keep the machine quiet.

Examples:
  fidsplat experiment counts
  fidsplat experiment counts --category huge"""

    def run(self) -> int:
        return measure(("counts",), self.settings(), self.json)


@dataclass
class Localisation(Threaded):
    """Pose errors by distance and tilt."""

    HELP: ClassVar[str] = """Pose errors of AprilTags and small QR codes by distance and tilt.

Codes of 0.16 m; 1280 x 720, 60 degrees; 0.5 to 4 m, 0 to 70 degrees; corners by `fidsplat detect`. The same
cameras for every method, the ideal texture's errors beside them. A run that was stopped goes on where it was.

Examples:
  fidsplat experiment localisation --quick
  fidsplat experiment localisation --mixture fitted"""

    def run(self) -> int:
        from fidsplat.experiments.localisation import LOCATED

        if self.category and not set(self.category) & set(LOCATED):
            raise InputError(f"localisation is of {' and '.join(LOCATED)}, not of {', '.join(self.category)}")
        return measure(("localisation",), self.settings(), self.json)


@dataclass
class Pictures(Drawn, Basic):
    """Picture sheets: every method beside the ideal."""

    HELP: ClassVar[
        str
    ] = """Draw sheets of marker 0 of each category, by every method, at tilts of 0, 45 and 70 degrees.

The report takes them in.

Examples:
  fidsplat experiment pictures
  fidsplat experiment pictures --category huge --mixture fitted"""

    def run(self) -> int:
        files = draw_sheets(self.settings())
        if self.json:
            print_json({"files": files})
        else:
            for file in files:
                console(False).print(file, markup=False, soft_wrap=True)
        return 0


def draw_sheets(settings: Settings) -> list[str]:
    """Draw the sheets with a progress bar; returns the files."""
    from rich.progress import track

    from fidsplat.experiments.methods import Painter
    from fidsplat.experiments.pictures import write_sheets
    from fidsplat.experiments.run import check
    from fidsplat.experiments.setup import chosen_categories
    from fidsplat.render import Renderer

    check(settings)
    categories = chosen_categories(settings.categories)
    painter = Painter(Renderer(settings.device), settings.trained)
    sheets = write_sheets(categories, settings.methods, painter, settings.seed, settings.out)
    bars = track(sheets, "pictures", total=len(categories), console=console(True), transient=True)
    return [str(file) for file in bars]


@dataclass
class All(Compared):
    """Every experiment, then the report."""

    HELP: ClassVar[str] = """Counts, localisation, views and angles, then the report.

--quick takes under five minutes on two cores. A run that was stopped loses nothing that was finished: the
same command goes on. Many machines share the work by --shard, and `merge` joins their results.

Examples:
  fidsplat experiment all --quick
  fidsplat experiment all -o results --device opencl:nvidia
  fidsplat experiment all --shard 2/8 -o shards"""

    def run(self) -> int:
        from fidsplat.experiments.run import NAMES, check

        settings = self.settings()
        check(settings)
        status = measure(NAMES, settings, self.json)
        if self.shard is not None:
            return status
        draw_sheets(settings)
        return write_report([settings.out], settings.out, console(True))
