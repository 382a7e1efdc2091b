"""Scene: its parts, and the files that they are kept in."""

from __future__ import annotations

import os

from fidsplat.formats import Progress
from fidsplat.quality import Quality
from fidsplat.scenes.parts import SceneParts
from fidsplat.scenes.read import read_scene
from fidsplat.scenes.write import write_scene


class Scene(SceneParts):
    """What is drawn and how. Raises InputError for a part of the wrong kind."""

    @staticmethod
    def load(
        path: str | os.PathLike[str],
        quality: Quality | str | None = None,
        progress: Progress | None = None,
    ) -> Scene:
        """Read a scene file (docs/scene-files.md).

        quality: instead of the file's; its knobs of markers hold for markers that do not say theirs.
        progress: called with what is being done and the share of it that is done, 0 to 1.

        Raises InputError, naming file and key, for whatever is wrong.
        """
        return Scene(**read_scene(path, quality, progress))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a scene file, and beside it one PLY file STEM-splats-I.ply for each of ``clouds``.

        Raises InputError when a file cannot be written, or a marker cannot be said in a scene file.
        """
        write_scene(self, path)
