"""Command `fidsplat fetch`: download captured scenes."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import tyro

from fidsplat.commands.options import Json
from fidsplat.commands.output import console, delayed_progress, print_lines, report


@dataclass
class Fetch:
    """Download a captured scene into the user's cache, and print its path.

    The files are public captures of other authors, checked by size and SHA-256. Without a name the command
    lists the scenes with author, licence and source. FIDSPLAT_SCENES is a folder or URL from which the files
    are read instead.

    Examples:
      fidsplat fetch
      fidsplat view $(fidsplat fetch biker)
    """

    name: tyro.conf.Positional[str | None] = None
    """NAME: scene to download"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.scenes.captured import captured_scenes, fetch_scene

        scenes = captured_scenes()
        if self.name is None:
            heads = ("name", "splats", "MB", "licence", "author", "source")
            rows = [
                (s.name, f"{s.splats:,}", f"{s.size / 1e6:.1f}", s.licence, s.author, s.source)
                for s in scenes.values()
            ]
            facts = {"scenes": [asdict(captured) for captured in scenes.values()]}
            return report(self.json, facts, table=("Captured scenes", heads, rows))
        with delayed_progress() as progress:
            path = fetch_scene(self.name, progress)
        scene = scenes[self.name]
        print_lines(console(True), scene.credit)
        facts = {"path": str(path), **{key: value for key, value in asdict(scene).items() if key != "files"}}
        return report(self.json, facts, str(path))
