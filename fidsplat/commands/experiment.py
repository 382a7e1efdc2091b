"""Command `fidsplat experiment`: run experiments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fidsplat.commands.calibrate import Calibrate, Tags
from fidsplat.commands.experiment_data import (
    Blender,
    Merge,
    Plants,
    Report,
    write_report,
)
from fidsplat.commands.experiment_localise import Localise
from fidsplat.commands.options import Json, repeatable, require_packages
from fidsplat.commands.output import (
    console,
    print_lines,
    report,
    run_sweeps,
)
from fidsplat.experiments.settings import (
    AngleSettings,
    ExperimentSettings,
    ImageSettings,
    MarkerSettings,
    MeasureSettings,
    ViewSettings,
)
from fidsplat.util.errors import InputError


@dataclass(frozen=True)
class Command(MarkerSettings):
    """Options of every experiment."""

    json: Json = False


def measure(names: tuple[str, ...], options: MeasureSettings, as_json: bool) -> int:
    """Run experiments and report the files of their results."""
    from fidsplat.experiments.run import prepared

    with prepared(names, options) as sweeps:
        run_sweeps(sweeps)
        files = {sweep.name: str(sweep.results.file) for sweep in sweeps if sweep.points}
    return report(as_json, {"files": files}, *files.values())


@repeatable
@dataclass(frozen=True)
class Angles(Command, AngleSettings):
    """Measure the largest tilt at which each detector finds and reads each marker (table 3).

    Every tilt from 0 to 89.8 degrees in steps of 0.2 is rendered and read by every detector: for tags
    OpenCV's aruco and the AprilTag library (if pupil-apriltags is installed), for QR codes OpenCV, zxing-cpp,
    and zxing-cpp on a vertically stretched image. Protocols: fixed-plane (2 x 2 plane, 800 x 800) and
    fixed-module (8 px per module, 1600 x 1600). An interrupted run resumes.

    Examples:
      fidsplat experiment angles --quick
      fidsplat experiment angles --ideal                     only the upper limit of the detectors; no device
      fidsplat experiment angles --protocol fixed-plane --category small --tilts 60:89.8:0.2
      fidsplat experiment angles --shard 1/4 --device opencl:nvidia
    """

    def run(self) -> int:
        return measure(("angles",), self, self.json)


@repeatable
@dataclass(frozen=True)
class Views(Command, ViewSettings):
    """Measure PSNR, SSIM, FLIP and LPIPS of 20 random views of each marker (table 4).

    Ground truths: the exact renderer (a pixel is the mean over its square), the exact renderer in linear
    light, and Blender's images of `fidsplat experiment blender`. FLIP needs flip-evaluator, LPIPS needs
    lpips. An interrupted run resumes.

    Examples:
      fidsplat experiment views --quick
      fidsplat experiment views --category huge --mixture fitted
      fidsplat experiment views --blender images/blender
    """

    def run(self) -> int:
        return measure(("views",), self, self.json)


@repeatable
@dataclass(frozen=True)
class Counts(Command, MeasureSettings):
    """Count components, rectangles and Gaussians of each marker, and time its making (table 2 and a chart).

    Compares single modules, runs of rows and the minimum partition, for every mixture. The time from text to
    splats is measured in a process that has made the marker before; keep the machine idle.

    Examples:
      fidsplat experiment counts
      fidsplat experiment counts --category huge
    """

    def run(self) -> int:
        return measure(("counts",), self, self.json)


@repeatable
@dataclass(frozen=True)
class Localisation(Command, ImageSettings):
    """Measure pose errors of AprilTags and small QR codes by distance and tilt.

    Codes of 0.16 m in images of 1280 x 720, 60 degrees wide, at 0.5 to 4 m and 0 to 70 degrees; corners are
    those of `fidsplat detect`. All methods and the ideal texture have the same cameras. An interrupted run
    resumes.

    Examples:
      fidsplat experiment localisation --quick
      fidsplat experiment localisation --mixture fitted
    """

    def run(self) -> int:
        from fidsplat.experiments.localisation import LOCATED

        if self.category and not set(self.category) & set(LOCATED):
            raise InputError(f"--category must be {' or '.join(LOCATED)}, got {', '.join(self.category)}")
        return measure(("localisation",), self, self.json)


@repeatable
@dataclass(frozen=True)
class All(Command, ExperimentSettings):
    """Run counts, localisation, views and angles, and write the report.

    --quick takes under five minutes on two cores. An interrupted run resumes. Several machines share the work
    by --shard, and `merge` joins their results.

    Examples:
      fidsplat experiment all --quick
      fidsplat experiment all -o results --device opencl:nvidia
      fidsplat experiment all --shard 2/8 -o shards
    """

    def run(self) -> int:
        from fidsplat.experiments.run import NAMES

        self.check()
        if self.shard is None:
            require_packages()
        status = measure(NAMES, self, self.json)
        if self.shard is not None:
            return status
        print_lines(console(True), f"report in {write_report([self.folder], self.folder)[0]}")
        return status


@dataclass
class Experiment:
    """Reproduce the paper's tables and figures with our methods and the ideal texture.

    Each experiment writes one file of results; an interrupted run resumes.

    Examples:
      fidsplat experiment all --quick                   all experiments, roughly, in minutes
      fidsplat experiment angles --category small       one experiment, one category
      fidsplat experiment report                        tables and charts of the results
      fidsplat experiment angles --help                 an experiment and its options
    """

    PARTS: ClassVar[dict[str, type]] = {
        "all": All,
        "angles": Angles,
        "views": Views,
        "counts": Counts,
        "localisation": Localisation,
        "localise": Localise,
        "calibrate": Calibrate,
        "tags": Tags,
        "blender": Blender,
        "plants": Plants,
        "merge": Merge,
        "report": Report,
    }
