"""`fidsplat experiment tags`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fidsplat.commands.options import Json, repeatable, require_packages
from fidsplat.commands.output import console, print_lines, report, show_progress
from fidsplat.commands.sweeps import run_sweeps
from fidsplat.experiments.tag_settings import TagSettings


@repeatable
@dataclass(frozen=True)
class Tags(TagSettings):
    """Which cause breaks which tag detector: rates and errors by cause, severity, family and scene.

    Renders markers in a greenhouse and in a captured scene, in equal poses for all causes, and reads them
    with OpenCV's aruco, the AprilTag library, locus-tag, zxing-cpp, OpenCV's QR detector and `detect`.
    Writes tags.jsonl, tags.csv with intervals of 95 %, and a page with failure curves. An interrupted run
    resumes. Several machines share the work by --shard, and `merge` joins their results; the same command
    then writes the page.

    Examples:
      fidsplat experiment tags --quick
      fidsplat experiment tags --cause blur --cause fog --family apriltag:36h11
      fidsplat experiment tags --detector mine:detect --detector aruco -o mine
      fidsplat experiment tags --labels images --views 100
    """

    page: Path | None = None
    """FILE.md|DIR: where the page and its charts are written (default: the folder for results)"""
    labels: Path | None = None
    """DIR: write the images with COCO and BOP annotations instead of measuring"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.tags import check, points_of, tag_sweep, write_labels
        from fidsplat.vision.readers import missing_readers

        check(self)
        if self.labels is not None:
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

        # earlier points of the file are included, e.g. of other detectors
        files, breaks = write_report(
            list(sweep.results.done.values()), self.folder, self.page or self.folder, self.seed
        )
        facts = {"files": {"tags": file, "report": list(map(str, files))}, "points": len(records)}
        facts["breaks"] = breaks.to_dict("records")
        rows = compact(breaks)
        table = ("Half of the views are read at", rows.columns, rows.itertuples(index=False))
        return report(self.json, facts, str(files[0]), table=table)
