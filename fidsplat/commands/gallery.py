"""`fidsplat gallery`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fidsplat.commands.output import Device, Json, console, late_progress, option, tell
from fidsplat.commands.render import load_source
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of


@dataclass
class Gallery:
    """Draw scenes, and make a page of their pictures.

    DIR/index.html shows every scene with its outputs, its splats and its scene file; it needs nothing but the
    pictures beside it. What has not changed since is not drawn again.

    Examples:
      fidsplat gallery examples/*.toml
      fidsplat gallery fidsplat-demo/scene.toml room.ply -o pictures --device opencl:nvidia
    """

    sources: Annotated[
        tyro.conf.Positional[tuple[str, ...]], option("SCENE.toml|FILE.ply...", "what to draw")
    ]
    out: Annotated[str, option("DIR", "folder (default: fidsplat-gallery)", "-o")] = "fidsplat-gallery"
    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.gallery import piece_of, write_gallery

        if not self.sources:
            raise InputError("no scene to draw; give scene files (.toml) or splat files, examples/*.toml say")
        with late_progress(console(True)) as progress:
            total, pieces = len(self.sources), []
            for k, source in enumerate(self.sources):
                progress(f"reading {source}", 0.5 * k / total)
                pieces.append(piece_of(path_of(source), load_source(source, None, lambda words, share: None)))
            files: list[Path] = []
            for file in write_gallery(path_of(self.out), pieces, self.device):
                files.append(file)
                progress(file.name, 0.5 + 0.5 * len(files) / (total + 1))
        page = str(files[-1])
        facts = {"page": page, "pictures": [str(file) for file in files[:-1]]}
        return tell(self.json, facts, f"{total} scenes in {page}")
