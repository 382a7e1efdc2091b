"""`fidsplat marker`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import (
    Json,
    Overwrite,
    console,
    late_progress,
    new_file,
    option,
    tell,
)
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    import fidsplat as fs


@dataclass
class Marker:
    """Make a marker of splats, say what it is made of, and write it as a PLY file with -o.

    SPEC is one of
      apriltag:FAMILY:ID   16h5, 25h9, 36h10, 36h11         apriltag:36h11:5
      aruco:FAMILY:ID      4x4_50 ... original, mip_36h12   aruco:4x4_50:7
      qr:TEXT              the smallest code that fits      qr:https://example.org
      qr-vN-L:TEXT         version N, error level L M Q H   qr-v22-L:TEXT
      image:FILE           any one-bit picture              image:logo.png
      svg:FILE             a drawing's filled shapes        svg:sign.svg, svg-512:sign.svg
      charuco:CxR:FAMILY   columns x rows of squares        charuco:7x5:4x4_50
      gridboard:CxR:FAMILY columns x rows of tags           gridboard:5x7:4x4_50
      aprilgrid:CxR:FAMILY the same with corner squares     aprilgrid:6x6:36h11

    The mixture exact, the default, draws every rectangle as one box with sharp edges. A PLY file has no
    boxes: -o then writes the Gaussians of fitted, and says so. facets are Gaussians for renderers that
    composite by depth at each pixel, opaque and sharp there and there only. refined optimises Gaussians as a
    whole by gradient, half a minute for a tag: those of marker.template=121 if --quality is not given.

    Knobs of the mixtures (fs.MarkerQuality) are part of a quality: marker.levels (1 to 8) and marker.density
    (1 to 100) of paper, marker.template of fitted (Gaussians of a rectangle: 1, 5, 9, 13, 25, 41, 121 or
    562), and marker.growth (modules).

    A picture of noise becomes tens of millions of splats; more than a million are refused unless --max-splats
    allows them.

    Examples:
      fidsplat marker apriltag:36h11:5 --size 0.16 -o tag.ply
      fidsplat marker qr:hello --quality marker.template=9
      fidsplat marker "qr:hello" --mixture paper --json
      fidsplat marker apriltag:36h11:5 --mixture refined -o tag.ply
    """

    spec: Annotated[tyro.conf.Positional[str], option("SPEC", "what to make, as above")]
    out: Annotated[str | None, option("FILE.ply", "write the splats there", "-o")] = None
    size: Annotated[
        float,
        option("M", "edge of the code (a board's width) in metres, quiet zone not counted (default: 1)"),
    ] = 1.0
    mixture: Annotated[
        str | None,
        option("NAME", "how it becomes splats: exact, fitted, facets, paper or refined (default: exact)"),
    ] = None
    iterations: Annotated[int | None, option("N", "pictures that refined looks at (default: 1000)")] = None
    device: Annotated[
        str | None, option("D", "that refined draws on (default: FIDSPLAT_DEVICE, or auto)")
    ] = None
    quality: Annotated[
        str | None, option("Q", "as `fidsplat render` takes it; what it says of markers, as above, holds")
    ] = None
    native_2dgs: Annotated[
        bool,
        tyro.conf.arg(help="leave the third scale out of the file, as 2DGS does", help_behavior_hint=""),
    ] = False
    max_splats: Annotated[int | None, option("N", "most splats that it may become (default: a million)")] = (
        None
    )
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.capture.quality import LADDER

        if self.native_2dgs and self.out is None:
            raise InputError("--native-2dgs is about the file that -o names; give -o FILE.ply")
        file = new_file(self.out, self.overwrite) if self.out is not None else None
        if file is not None and file.suffix.lower() != ".ply":
            raise InputError(f"splats are written as PLY: name {file.with_suffix('.ply')}, not {file}")
        limit = {} if self.max_splats is None else {"max_splats": self.max_splats}
        refined = self.mixture == "refined"
        if not refined and (self.iterations is not None or self.device is not None):
            raise InputError("--iterations and --device are about --mixture refined; write that too")
        mixture = "fitted" if refined else self.mixture
        quality = fs.Quality.of(self.quality).marker
        if refined and self.quality is None:
            from fidsplat.capture.quality import LADDER

            quality = fs.MarkerQuality(template=LADDER)
        with late_progress(console(self.json)) as progress:
            made = fs.marker(self.spec, self.size, mixture, quality=quality, progress=progress, **limit)
            if refined:
                made = self._refined(made, progress)
        if file is not None:
            fs.save_ply(made.gaussians, file, native_2dgs=self.native_2dgs)
        written = "fitted" if made.mixture == "exact" else made.mixture
        dark = int(made.is_dark.sum())
        facts = {
            "spec": made.spec,
            "kind": made.kind,
            "family": made.family,
            "id": made.id,
            "payload": made.payload,
            "shape": list(made.bits.shape),
            "quiet_zone": made.quiet_zone,
            "components": made.components,
            "rectangles": {"dark": dark, "light": len(made.boxes) - dark},
            "splats": len(made.cloud),
            "seconds": made.seconds,
            "mixture": made.mixture,
            "written": None if file is None else {"mixture": written, "splats": len(made.gaussians)},
            "size_m": made.size,
            "module_m": made.module,
            "file": str(file) if file else None,
        }
        rows = [
            ("modules", f"{made.bits.shape[0]} x {made.bits.shape[1]}, quiet zone {made.quiet_zone}"),
            ("size", f"{made.size:g} m, a module {made.module * 1e3:.4g} mm"),
            ("components", made.components),
            ("rectangles", f"{dark} dark, {len(made.boxes) - dark} light"),
            ("splats", f"{len(made.cloud)} ({made.mixture})"),
            ("seconds", f"{made.seconds:.3f}"),
        ]
        if file is not None:
            rows.append(("written", file))
        if file is not None and made.mixture == "exact":
            rows.append(("", f"as {len(made.gaussians)} Gaussians (fitted): a PLY file has no boxes"))
        if file is not None and made.mixture == "facets":
            rows.append(("", "for --quality order=pixel: by the depth of centres they hide each other"))
        return tell(self.json, facts, table=(made.spec, ("", ""), rows))

    def _refined(self, made: fs.Marker, progress: Callable[[str, float], None]) -> fs.Marker:
        """The marker's Gaussians, optimised on a device."""
        import fidsplat as fs
        from fidsplat.train.refining import ITERATIONS, refine

        iterations = ITERATIONS if self.iterations is None else self.iterations
        return refine(
            made,
            fs.Renderer(self.device),
            iterations,
            progress=lambda step: progress(f"refined, {step.psnr:.1f} dB", step.iteration / iterations),
        )
