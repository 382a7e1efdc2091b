"""`fidsplat convert`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from fidsplat.commands.output import (
    Device,
    Json,
    Overwrite,
    console,
    late_progress,
    new_file,
    option,
    switch,
    tell,
)
from fidsplat.util.errors import InputError


@dataclass
class Convert:
    """Write splats in another format, and say what that costs.

    Formats by their endings: .ply, .splat, .spz, .glb and .gltf (KHR_gaussian_splatting), .usda, .usdc and
    .usd (OpenUSD's ParticleField; extra usd), and .sog, which is read only. What B cannot hold is said in
    words; then both files are drawn from where `fidsplat render A` looks, and the largest and mean difference
    of the pictures and their PSNR are measured.

    Examples:
      fidsplat convert room.ply room.spz
      fidsplat convert tag.ply tag.usda --json
    """

    source: Annotated[tyro.conf.Positional[str], option("A", "a splat file")]
    target: Annotated[tyro.conf.Positional[str], option("B", "the file to write")]
    no_pictures: Annotated[bool, switch("do not draw both")] = False
    device: Device = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.formats import losses, save_splats
        from fidsplat.formats.files import check_writable

        known = check_writable(self.target)
        source, target = Path(self.source), Path(self.target)
        if source.exists() and target.exists() and source.samefile(target):
            raise InputError(f"{self.source} and {self.target} are one file; give B another name")
        new_file(self.target, self.overwrite)
        with late_progress(console(True)) as progress:
            cloud = fs.load_splats(self.source, progress)
        lost = losses(cloud, self.target)
        save_splats(cloud, self.target)
        sizes = [Path(name).stat().st_size for name in (self.source, self.target)]
        facts: dict[str, Any] = {"source": self.source, "target": self.target, "format": known.name}
        facts |= {"splats": len(cloud), "bytes": sizes, "lost": lost, "error": None}
        if not self.no_pictures and len(cloud):
            with console(True).status("drawing both"):
                facts["error"] = picture_error(cloud, fs.load_splats(self.target), self.device)
        lines = [f"{len(cloud):,} splats, {sizes[0]:,} to {sizes[1]:,} bytes, {known.name}: {self.target}"]
        lines += [f"not kept: {words}" if not words.startswith("rounds") else words for words in lost]
        if error := facts["error"]:
            psnr = "the same bits" if math.isinf(error["psnr"]) else f"{error['psnr']:.1f} dB"
            apart = f"pictures differ by {error['largest']:.2g} at most, {error['mean']:.2g} in the mean"
            lines.append(f"{apart}; {psnr}")
        return tell(self.json, facts, *lines)


def picture_error(before, after, device: str | None) -> dict[str, float]:
    """How far the pictures of two clouds are apart, seen from where the first fits: largest and mean
    difference of rgb, 0 to 1, and PSNR in dB, infinite for the same bits."""
    import numpy as np

    import fidsplat as fs
    from fidsplat.commands.framing import framing_camera

    renderer, camera = fs.Renderer(device), framing_camera(before)
    one, other = (renderer.render(cloud, camera)["rgb"].astype(np.float64) for cloud in (before, after))
    apart = np.abs(one - other)
    square = float((apart * apart).mean())
    psnr = math.inf if square == 0 else -10 * math.log10(square)
    return {"largest": float(apart.max()), "mean": float(apart.mean()), "psnr": psnr}
