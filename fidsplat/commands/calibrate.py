"""`fidsplat experiment calibrate`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from fidsplat.commands.declarations import option
from fidsplat.commands.options import Device, Json, Overwrite, new_file, require_packages
from fidsplat.commands.output import json_text, report, show_progress
from fidsplat.experiments.calibrate import CalibrationSettings


@dataclass
class Calibrate:
    """Calibration of a camera with known intrinsics by OpenCV, and the number of views for 0.1 pixels.

    Renders views of a ChArUco board by a lens model, with shot noise, detects its corners and calibrates from
    random choices of 3, 4, 6, 8 ... views. The error of the projection is the root mean square over the
    image, after the best rotation, which poses absorb. Writes DIR/calibrate.json and DIR/calibrate.svg.

    Examples:
      fidsplat experiment calibrate
      fidsplat experiment calibrate --lens fisheye --views 64 --electrons 1000
    """

    out: Annotated[str, option("DIR", "folder", "-o")] = "fidsplat-calibrate"
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
        found = [one for one in views if one is not None]
        if len(found) < 3:
            raise FidsplatError(
                f"the board was found in {len(found)} of {len(views)} views; use a larger size"
            )
        rows = list(errors_by_count(settings, [one.view for one in found]))
        corner = float(np.sqrt(np.mean(np.concatenate([one.errors for one in found]) ** 2)))
        facts = {
            "settings": asdict(settings),
            "device": renderer.device.title,
            "found": len(found),
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
        few = facts["needed"] or f"more than {len(found)}"
        return report(
            self.json,
            facts,
            f"views for 0.1 pixels in three of four calibrations: {few}",
            noise,
            str(file),
            table=(
                f"Median errors, {settings.lens}, {len(found)} views",
                ("views", "RMS [px]", *names),
                table,
            ),
        )
