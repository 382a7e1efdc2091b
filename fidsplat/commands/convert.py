"""Command `fidsplat convert`: convert splat files and meshes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from fidsplat.commands.options import Device, Json, Overwrite
from fidsplat.commands.output import console, delayed_progress, report
from fidsplat.util.errors import InputError
from fidsplat.util.files import existing, new_file


@dataclass
class MeshOptions:
    """Options of a triangle mesh."""

    mesh: bool = False
    """write a triangle mesh: .glb, .ply, .obj, .stl, or .xml for MuJoCo"""
    voxel: float | None = None
    """M: voxel size of the mesh in metres (default: a 200th of the longest side)"""
    cameras: str | None = None
    """FILE: cameras whose depth images are fused: COLMAP, transforms.json, a trajectory (default: up to 64
    views around the scene)"""
    faces: int | None = None
    """N: maximum number of triangles (extra: mesh)"""
    parts: int | None = None
    """N: maximum number of convex parts in .xml; more fill less space in front of surfaces (default: 512)"""

    def __post_init__(self) -> None:
        if not self.mesh and (self.voxel, self.cameras, self.faces, self.parts) != (None,) * 4:
            raise InputError(
                "--voxel, --cameras, --faces and --parts must be given with --mesh, got none; add it"
            )
        if self.parts is not None and self.parts < 1:
            raise InputError(f"--parts must be at least 1, got {self.parts}")


@dataclass
class Convert:
    """Convert splats to another format and measure the loss, or convert them to a triangle mesh.

    Formats by suffix: .ply, .splat, .spz, .glb and .gltf (KHR_gaussian_splatting), .usda, .usdc and .usd
    (OpenUSD's ParticleField; extra usd), .sog and meta.json (SOG). The command lists data that the format of
    OUT cannot store, renders both files from the camera of `fidsplat render IN`, and prints the maximum and
    mean difference of the images and their PSNR.

    Examples:
      fidsplat convert room.ply room.spz
      fidsplat convert tag.ply tag.usda --json
      fidsplat convert scene.toml scene.html         one page that renders it offline, in a browser
      fidsplat convert city.fss city/lod-meta.json   a store as streamed SOG
      fidsplat convert room.ply room.glb --mesh --cameras room/sparse/0      a triangle mesh
      fidsplat convert pot.ply pot.xml --mesh --voxel 0.01                   convex parts for MuJoCo
    """

    source: tyro.conf.Positional[str]
    """IN: splat file to read"""
    target: tyro.conf.Positional[str]
    """OUT: splat file to write"""
    spz_version: int = 4
    """3|4: version of SPZ; 3 is for older readers and has no labels and coplanar groups"""
    no_images: Annotated[bool, "do not render and compare both files", "--no-pictures"] = False
    mesh: MeshOptions = field(default_factory=MeshOptions)
    device: Device = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.formats import losses, save_splats
        from fidsplat.formats.files import check_writable, stored_bytes
        from fidsplat.formats.sog_streamed import META
        from fidsplat.formats.spz import save_spz
        from fidsplat.store.layout import SUFFIX

        existing(self.source)  # a missing source is reported before an unsuitable target
        if self.mesh.mesh:
            return self._mesh()
        if Path(self.source).suffix == SUFFIX and Path(self.target).name == META:
            return self._export()
        if Path(self.target).suffix.lower() == ".html":
            return self._page()
        known = check_writable(self.target)
        source, target = Path(self.source), Path(self.target)
        if target.exists() and source.samefile(target):
            raise InputError(f"OUT must be another file than IN, got {self.target}")
        new_file(self.target, self.overwrite)
        with delayed_progress() as progress:
            cloud = fs.load_splats(self.source, progress)
        lost = losses(cloud, self.target)
        if target.suffix.lower() == ".spz":
            save_spz(cloud, target, self.spz_version)
        else:
            save_splats(cloud, self.target)
        sizes = [stored_bytes(name) for name in (self.source, self.target)]
        facts: dict[str, Any] = {"source": self.source, "target": self.target, "format": known.name}
        facts |= {"splats": len(cloud), "bytes": sizes, "lost": lost, "error": None}
        if not self.no_images and len(cloud):
            with console(True).status("rendering both"):
                facts["error"] = image_error(cloud, fs.load_splats(self.target), self.device)
        lines = [f"{len(cloud):,} splats, {sizes[0]:,} to {sizes[1]:,} bytes, {known.name}: {self.target}"]
        lines += [f"lost: {words}" if not words.startswith("rounds") else words for words in lost]
        if error := facts["error"]:
            psnr = "bit-identical" if math.isinf(error["psnr"]) else f"{error['psnr']:.1f} dB"
            difference = f"image error: largest {error['largest']:.2g}, mean {error['mean']:.2g}"
            lines.append(f"{difference}; {psnr}")
        return report(self.json, facts, *lines)

    def _mesh(self) -> int:
        import numpy as np

        import fidsplat as fs
        from fidsplat.formats.convex_parts import MAX_PARTS
        from fidsplat.formats.meshes import check_mesh_file, save_mesh
        from fidsplat.scenes.sources import cameras_of, load_source

        target = check_mesh_file(new_file(self.target, self.overwrite))
        with delayed_progress() as progress:
            scene = load_source(self.source, progress=progress)
            views = None if self.mesh.cameras is None else cameras_of(self.mesh.cameras, scene)
            renderer = fs.Renderer(self.device or scene.device)
            mesh = fs.scene_mesh(scene, views, self.mesh.voxel, renderer, progress)
        if self.mesh.faces is not None:
            mesh = mesh.simplified(self.mesh.faces)
        parts = save_mesh(mesh, target, self.mesh.parts or MAX_PARTS)
        facts: dict[str, Any] = {"source": self.source, "target": self.target, "format": "mesh"}
        facts |= {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "area_m2": mesh.area}
        line = f"{len(mesh.faces):,} triangles: {self.target}"
        if parts:
            gaps = np.quantile(np.concatenate([part.gaps for part in parts]), (0.5, 0.95, 1))
            facts |= {"parts": len(parts), "filled_m": dict(zip(("median", "p95", "max"), gaps, strict=True))}
            line += (
                f", {len(parts)} convex parts, which fill {gaps[0]:.2g} m in front of the surface (median; "
                f"95 %: {gaps[1]:.2g} m, maximum {gaps[2]:.2g} m)"
            )
        return report(self.json, facts, line)

    def _page(self) -> int:
        from fidsplat.scenes.sources import load_source
        from fidsplat.viewer.scene_page import VERSION, save_page

        new_file(self.target, self.overwrite)
        with delayed_progress() as progress:
            scene = load_source(self.source, progress=progress)
        save_page(scene, self.target, Path(self.source).stem)
        size = Path(self.target).stat().st_size
        facts = {"source": self.source, "target": self.target, "format": "HTML", "bytes": size}
        return report(self.json, facts, f"{size:,} bytes, with PlayCanvas Engine {VERSION}: {self.target}")

    def _export(self) -> int:
        import fidsplat as fs
        from fidsplat.store.streamed import export_streamed

        new_file(self.target, self.overwrite)
        store = fs.Store(self.source)
        export_streamed(store, Path(self.target))
        facts = {"source": self.source, "target": self.target, "format": "streamed SOG", "splats": len(store)}
        return report(self.json, facts, f"{len(store):,} splats as streamed SOG: {self.target}")


def image_error(before, after, device: str | None) -> dict[str, float]:
    """Maximum and mean difference of rgb (0 to 1) and PSNR [dB] of two clouds, from a camera that frames the
    first; the PSNR of bit-identical images is infinite."""
    import numpy as np

    import fidsplat as fs
    from fidsplat.scenes.sources import framing_camera
    from fidsplat.vision.metrics import psnr

    renderer, camera = fs.Renderer(device), framing_camera(before)
    one, other = (renderer.render(cloud, camera)["rgb"].astype(np.float64) for cloud in (before, after))
    difference = np.abs(one - other)
    return {
        "largest": float(difference.max()),
        "mean": float(difference.mean()),
        "psnr": psnr(one, other),
    }
