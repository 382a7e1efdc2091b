"""Commands `fidsplat experiment calibrate` and `tags`: calibrate cameras, test tag detectors."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from fidsplat.commands.options import Device, Json, Overwrite, repeatable, require_packages
from fidsplat.commands.output import console, json_text, print_lines, report, run_sweeps, show_progress
from fidsplat.experiments.calibrate import CalibrationSettings
from fidsplat.experiments.tags import TagSettings
from fidsplat.util.errors import InputError
from fidsplat.util.files import new_file


@dataclass
class Calibrate:
    """Calibrate a camera with known intrinsics by OpenCV, and find the number of views for 0.1 pixels.

    Renders views of a ChArUco board with a lens model and shot noise, detects the corners, and calibrates
    from random subsets of 3, 4, 6, 8 ... views. The projection error is the RMS over the image after the best
    rotation, which the poses absorb. Writes DIR/calibrate.json and DIR/calibrate.svg.

    Examples:
      fidsplat experiment calibrate
      fidsplat experiment calibrate --lens fisheye --views 64 --electrons 1000
    """

    out: str = "fidsplat-calibrate"
    """DIR: folder"""
    camera: CalibrationSettings = field(default_factory=CalibrationSettings)
    device: Device = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import numpy as np

        import fidsplat as fs
        from fidsplat.util.errors import FidsplatError

        require_packages()
        from fidsplat.experiments.calibrate import errors_by_count, needed, rendered_views, write_chart
        from fidsplat.util.files import writable_folder, write_file
        from fidsplat.vision.calibration import parameters

        settings, folder = self.camera, writable_folder(self.out)
        file = new_file(str(folder / "calibrate.json"), self.overwrite)
        renderer = fs.Renderer(self.device)
        views = list(show_progress("views", rendered_views(settings, renderer), settings.views))
        detected = [board for board in views if board is not None]
        if len(detected) < 3:
            raise FidsplatError(
                f"the board must be found in at least 3 views, got {len(detected)} of {len(views)}; use a "
                "larger --size"
            )
        rows = list(errors_by_count(settings, [board.view for board in detected]))
        corner = float(np.sqrt(np.mean(np.concatenate([board.errors for board in detected]) ** 2)))
        facts = {
            "settings": asdict(settings),
            "device": renderer.device.title,
            "found": len(detected),
            "corner_rms_px": corner,
        }
        facts |= {"truth": parameters(settings.truth), "rows": rows, "needed": needed(rows)}
        write_file(file, json_text(facts))
        write_chart(rows, Path(self.out) / "calibrate.svg")
        names = list(facts["truth"])
        table = [
            (row["views"], f"{row['projection_px']:.3f}", *(f"{row['errors'][name]:.1g}" for name in names))
            for row in rows
        ]
        noise = f"corners: RMS error {corner:.3f} pixels in x and y"
        few = facts["needed"] or f"more than {len(detected)}"
        return report(
            self.json,
            facts,
            f"views for 0.1 pixels in three of four calibrations: {few}",
            noise,
            str(file),
            table=(
                f"Median errors, {settings.lens}, {len(detected)} views",
                ("views", "RMS [px]", *names),
                table,
            ),
        )


@repeatable
@dataclass(frozen=True)
class Tags(TagSettings):
    """Measure which cause breaks which tag detector, by severity, family and scene.

    Renders markers in a greenhouse and in a captured scene, in the same poses for all causes, and reads them
    with OpenCV's aruco, the AprilTag library, locus-tag, zxing-cpp, OpenCV's QR detector and `detect`.
    Writes tags.jsonl, tags.csv with 95 % intervals, and a page with failure curves. An interrupted run
    resumes. Several machines share the work by --shard, and `fidsplat experiment merge` joins their results;
    the same command then writes the page.

    Examples:
      fidsplat experiment tags --quick
      fidsplat experiment tags --cause blur --cause fog --family apriltag:36h11
      fidsplat experiment tags --detector mine:detect --detector aruco -o mine
      fidsplat experiment tags --labels images --views 100
    """

    page: Path | None = None
    """FILE.md|DIR: page with its charts (default: the folder for results)"""
    labels: Path | None = None
    """DIR: write the images with COCO and BOP annotations instead of measuring"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.tags import check, points_of, tag_sweep, write_labels
        from fidsplat.vision.readers import missing_readers

        check(self)
        if self.labels is not None:
            given = {"-o": self.out, "--page": self.page, "--detector": self.detector}
            if names := [name for name, value in given.items() if value]:
                raise InputError(
                    f"--labels must be given without options of measurements, got {', '.join(names)}; "
                    "measure in another run"
                )
            points = write_labels(self, self.labels)
            names = [str(folder) for folder in show_progress("points", points, len(points_of(self)))]
            return report(self.json, {"folders": names}, f"{len(names)} folders in {self.labels}")
        if self.shard is None:
            require_packages()
        if not self.detector:
            print_lines(
                console(True),
                *(f"{name} is skipped; pip install {package}" for name, package in missing_readers().items()),
            )
        with tag_sweep(self) as sweep:
            records, file = run_sweeps([sweep]), str(sweep.results.file)
        if self.shard is not None:
            return report(self.json, {"files": {"tags": file}}, file)
        from fidsplat.experiments.tags_report import compact, write_report

        # the file also has earlier points, e.g. of other detectors
        files, breaks = write_report(
            list(sweep.results.done.values()), self.folder, self.page or self.folder, self.seed
        )
        facts = {"files": {"tags": file, "report": list(map(str, files))}, "points": len(records)}
        facts["breaks"] = breaks.to_dict("records")
        rows = compact(breaks)
        table = ("Half of the views are read at", rows.columns, rows.itertuples(index=False))
        return report(self.json, facts, str(files[0]), table=table)
