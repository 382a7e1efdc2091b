"""Command `fidsplat marker`: make a marker and place it in a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from fidsplat.commands.options import Json, Overwrite
from fidsplat.commands.output import delayed_progress, report
from fidsplat.util.arguments import changes_of
from fidsplat.util.errors import InputError
from fidsplat.util.files import new_file

if TYPE_CHECKING:
    import fidsplat as fs


@dataclass
class Placing:
    """Placement of a marker in a scene."""

    scene: str | None = None
    """SCENE.toml|FILE.ply|STORE.fss: scene to place the marker in; prints its table"""
    at_pixel: tuple[float, float] | None = None
    """X Y: place it on the surface at this pixel of --scene"""
    up: tuple[float, float, float] | None = None
    """X Y Z: vertical of the scene (default: the guess of `fidsplat info`)"""
    lift: float | None = None
    """M: metres in front (default: 1 mm and twice the roughness of the surface)"""
    radius: float | None = None
    """M: radius of the fitted patch (default: that of the marker)"""
    light: str | None = None
    """SOURCE,KEY=VALUE: light it by the scene, e.g. scene or lights,roughness=0.3"""
    append: bool = False
    """append the table to SCENE.toml"""

    def __post_init__(self) -> None:
        if (self.scene is None) != (self.at_pixel is None):
            raise InputError("--scene SCENE and --at-pixel X Y must be given together, got one of them")
        others = (self.up, self.lift, self.radius, self.light)
        if self.scene is None and (self.append or any(value is not None for value in others)):
            raise InputError(
                "--up, --lift, --radius, --light and --append must be given with --scene SCENE and "
                "--at-pixel X Y, got neither; add them"
            )
        if self.append and not str(self.scene).lower().endswith(".toml"):
            raise InputError(f"--append must have a scene file (.toml), got {self.scene}")

    def placed(self, marker: fs.Marker, device: str | None) -> tuple[dict[str, Any], str]:
        """Facts of the surface, and the [[markers]] table of the placed marker."""
        import fidsplat as fs
        from fidsplat.scenes.lights import Lighting
        from fidsplat.scenes.sources import load_source
        from fidsplat.scenes.write import marker_block
        from fidsplat.splats.rotations import matrix_to_quaternion
        from fidsplat.viewer.scene_file import SceneFile

        assert self.scene is not None
        file = SceneFile(Path(self.scene)) if self.append else None
        light = Lighting.of(self.light)
        with delayed_progress() as progress:
            scene = load_source(self.scene, None, progress)
        renderer = fs.Renderer(device or scene.device)
        options: dict[str, Any] = {"renderer": renderer, "resident": renderer.upload(scene)}
        options["radius"] = marker.radius if self.radius is None else self.radius
        surface = scene.surface_at(pixel=self.at_pixel, **options)
        scene = scene.place(marker, pixel=self.at_pixel, up=self.up, lift=self.lift, light=light, **options)
        pose = scene.markers[-1].pose
        block = marker_block(scene.markers[-1], Path(self.scene).parent, scene.quality)
        if file is not None:
            file.add_marker(block)
        facts = {
            "position": pose[:3, 3],
            "quaternion": matrix_to_quaternion(pose[:3, :3]),
            "normal": surface.normal,
            "inlier_fraction": surface.inlier_fraction,
            "roughness_m": surface.roughness,
            "radius_m": surface.radius,
            "appended": self.append,
        }
        return facts, block


@dataclass
class Marker:
    """Make a marker of splats; -o writes it as a PLY file, --at-pixel places it on a surface of a scene.

    SPEC is one of
      apriltag:FAMILY:ID   16h5, 25h9, 36h10, 36h11,        apriltag:36h11:5
                           standard41h12, standard52h13,
                           circle21h7, circle49h12, custom48h12
      aruco:FAMILY:ID      4x4_50 ... original, mip_36h12   aruco:4x4_50:7
      qr:TEXT              the smallest code that fits      qr:https://example.org
      qr-vN-L:TEXT         version N, error level L M Q H   qr-v22-L:TEXT
      image:FILE           any one-bit image                image:logo.png
      svg:FILE             filled shapes of an SVG          svg:sign.svg, svg-512:sign.svg
      charuco:CxR:FAMILY   columns x rows of squares        charuco:7x5:4x4_50
      gridboard:CxR:FAMILY columns x rows of tags           gridboard:5x7:4x4_50
      aprilgrid:CxR:FAMILY the same with corner squares     aprilgrid:6x6:36h11

    Mixtures: exact (default) renders every rectangle as one box with sharp edges; PLY files have no boxes, so
    -o writes the Gaussians of fitted. facets are Gaussians for renderers that composite by depth per pixel,
    where they are opaque and sharp. refined optimises the Gaussians of marker.template=121 (or of --quality)
    by gradient descent, half a minute for a tag.

    Settings of the mixtures (fs.MarkerQuality) are part of a quality: marker.levels (1 to 8) and
    marker.density (1 to 100) of paper, marker.template of fitted (Gaussians per rectangle: 1, 5, 9, 13, 25,
    41, 121 or 562), and marker.growth (modules).

    An image of noise can require tens of millions of splats; --max-splats raises the limit of one million.

    --shape bends the sheet: cylinder (radius, axis x or y), cone (radius, taper), bent (radius, length,
    axis), edge (radius, offset, axis) or crumpled (height, length, seed), lengths in metres; deviation is the
    largest distance of the splats from the surface. --wear has severities from 0 to 1: bleed, coarseness,
    fading, dirt, drops, scratches, tear, fold, cover; and a seed. --light has the settings of fs.Lighting:
    paper, ink, roughness, reflectance, view, exposure, response, ambient ("0.4 0.4 0.5") ...

    Examples:
      fidsplat marker apriltag:36h11:5 --size 0.16 -o tag.ply
      fidsplat marker apriltag:36h11:5 --size 0.16 --shape cylinder,radius=0.05 --wear fading=0.3,dirt=0.1
      fidsplat marker qr:hello --quality marker.template=9
      fidsplat marker "qr:hello" --mixture paper --json
      fidsplat marker apriltag:36h11:5 --mixture refined -o tag.ply
      fidsplat marker apriltag:36h11:5 --size 0.16 --scene scene.toml --at-pixel 640 360 --append
    """

    spec: tyro.conf.Positional[str]
    """SPEC: marker, e.g. apriltag:36h11:5"""
    out: str | None = None
    """FILE.ply: file for the splats"""
    size: float = 1.0
    """M: edge of the code (width of a board) in metres, without the quiet zone"""
    mixture: str | None = None
    """NAME: mixture: exact, fitted, facets, paper or refined (default: exact)"""
    iterations: int | None = None
    """N: iterations of refined (default: 1000)"""
    device: str | None = None
    """D: device of refined and --scene (default: FIDSPLAT_DEVICE, or auto)"""
    quality: str | None = None
    """Q: quality with settings of the mixtures, as above"""
    shape: str | None = None
    """KIND,KEY=VALUE: surface that the sheet is bent to, e.g. cylinder,radius=0.05"""
    wear: str | None = None
    """KEY=VALUE: print defects and wear, e.g. fading=0.4,dirt=0.2,seed=3"""
    native_2dgs: bool = False
    """omit the third scale from the file, as 2DGS does"""
    max_splats: int | None = None
    """N: maximum number of splats (default: 1000000)"""
    placing: Placing = field(default_factory=Placing)
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.capture.quality import LADDER

        if self.native_2dgs and self.out is None:
            raise InputError("--native-2dgs must be given with -o FILE.ply, got no -o; add it")
        file = new_file(self.out, self.overwrite) if self.out is not None else None
        if file is not None and file.suffix.lower() != ".ply":
            raise InputError(f"-o must be a .ply file, got {file}")
        limit = {} if self.max_splats is None else {"max_splats": self.max_splats}
        changed = {"shape": self.shape, "wear": self.wear}
        refined = self.mixture == "refined"
        placing = self.placing.scene is not None
        if not refined and (self.iterations is not None or (self.device is not None and not placing)):
            raise InputError(
                "--iterations and --device must be given with --mixture refined, got "
                f"{self.mixture or 'no mixture'}; add it, or leave them out"
            )
        mixture = "fitted" if refined else self.mixture
        quality = fs.Quality.of(self.quality).marker
        if refined and self.quality is None:
            quality = fs.MarkerQuality(template=LADDER)
        with delayed_progress() as progress:
            marker = fs.marker(
                self.spec, self.size, mixture, quality=quality, progress=progress, **limit, **changed
            )
            if refined:
                marker = self._refine(marker, progress)
        if file is not None:
            fs.save_ply(marker.gaussians, file, native_2dgs=self.native_2dgs)
        written = "fitted" if marker.mixture == "exact" else marker.mixture
        dark = int(marker.is_dark.sum())
        facts: dict[str, Any] = {
            "spec": marker.spec,
            "kind": marker.kind,
            "family": marker.family,
            "id": marker.id,
            "payload": marker.payload,
            "shape": list(marker.bits.shape),
            "quiet_zone": marker.quiet_zone,
            "components": marker.components,
            "rectangles": {"dark": dark, "light": len(marker.boxes) - dark},
            "splats": len(marker.cloud),
            "seconds": marker.seconds,
            "mixture": marker.mixture,
            "written": None if file is None else {"mixture": written, "splats": len(marker.gaussians)},
            "surface": None
            if marker.shape is None
            else {"kind": marker.shape.kind} | changes_of(marker.shape),
            "wear": None if marker.wear is None else changes_of(marker.wear),
            "size_m": marker.size,
            "module_m": marker.module,
            "file": str(file) if file else None,
        }
        rows = [
            ("modules", f"{marker.bits.shape[0]} x {marker.bits.shape[1]}, quiet zone {marker.quiet_zone}"),
            ("size", f"{marker.size:g} m, a module {marker.module * 1e3:.4g} mm"),
            ("components", marker.components),
            ("rectangles", f"{dark} dark, {len(marker.boxes) - dark} light"),
            ("splats", f"{len(marker.cloud)} ({marker.mixture})"),
            *((name, text) for name, text in changed.items() if text is not None),
            ("seconds", f"{marker.seconds:.3f}"),
        ]
        if file is not None:
            rows.append(("written", file))
        if file is not None and marker.mixture == "exact":
            rows.append(("", f"as {len(marker.gaussians)} Gaussians (fitted), as a PLY file has no boxes"))
        if file is not None and marker.mixture == "facets":
            rows.append(("", "for --quality order=pixel; sorted by their centres they occlude each other"))
        lines = []
        if placing:
            facts["placed"], block = self.placing.placed(marker, self.device)
            percent, roughness = (
                100 * facts["placed"]["inlier_fraction"],
                1e3 * facts["placed"]["roughness_m"],
            )
            rows.append(("surface", f"{percent:.0f} % of the patch in one plane, {roughness:.2g} mm RMS"))
            appended = f"appended to {self.placing.scene}"
            lines = [appended if self.placing.append else f"\n{block.rstrip()}"]
        return report(self.json, facts, *lines, table=(marker.spec, ("", ""), rows))

    def _refine(self, marker: fs.Marker, progress: Callable[[str, float], None]) -> fs.Marker:
        """The marker with Gaussians that are optimised on a device."""
        import fidsplat as fs
        from fidsplat.train.refining import ITERATIONS, refine

        iterations = ITERATIONS if self.iterations is None else self.iterations
        return refine(
            marker,
            fs.Renderer(self.device),
            iterations,
            progress=lambda step: progress(f"refined, {step.psnr:.1f} dB", step.iteration / iterations),
        )
