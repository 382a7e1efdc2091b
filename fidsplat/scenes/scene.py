"""Scene: splats, markers, camera and capture, with loading and saving."""

from __future__ import annotations

import os

from fidsplat.capture.quality import Quality
from fidsplat.formats import Progress
from fidsplat.scenes.parts import SceneParts
from fidsplat.scenes.read import read_scene
from fidsplat.scenes.write import write_scene
from fidsplat.util.markup import Summarised, point


class Scene(SceneParts, Summarised):
    """Splats, markers, camera and capture. Raises InputError for a field of the wrong type."""

    def __repr__(self) -> str:
        words = (f"{len(cloud):,} splats" for cloud in (*self.stores, *self.clouds))
        return f"Scene({', '.join([*words, *(placed.marker.spec for placed in self.markers)])})"

    def summary(self) -> dict[str, str]:
        """Its content in words."""
        rows = {f"store {i}": f"{len(s):,} splats in {s.path}" for i, s in enumerate(self.stores)}
        rows |= {f"cloud {i}": f"{len(cloud):,} splats" for i, cloud in enumerate(self.clouds)}
        for placed in self.markers:
            moves = "" if placed.motion is None else ", moves"
            size, place = f"{placed.marker.size:g} m", point(placed.pose[:3, 3])
            rows[f"marker {placed.label}"] = f"{placed.marker.spec}, {size} at {place}{moves}"
        if self.camera is not None:
            lens = "pinhole" if self.camera.lens is None else self.camera.lens.kind
            rows["camera"] = (
                f"{self.camera.width} x {self.camera.height}, {lens}, at {point(self.camera.position)}"
            )
        return rows | {"outputs": ", ".join(self.outputs)}

    @staticmethod
    def load(
        path: str | os.PathLike[str],
        quality: Quality | str | None = None,
        progress: Progress | None = None,
    ) -> Scene:
        """Read a scene file (docs/scene-files.md).

        quality: replaces the file's; its marker settings apply to markers without their own.
        progress: called with the current step and its share done, 0 to 1.

        Raises InputError, which names file and key.
        """
        return Scene(**read_scene(path, quality, progress))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a scene file, and next to it a PLY file STEM-splats-I.ply for each of ``clouds``.

        Raises InputError if a file cannot be written, or a marker cannot be expressed in a scene file.
        """
        write_scene(self, path)
