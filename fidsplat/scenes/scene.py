"""Scene: splats, markers, camera and capture, with loading and saving."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.scenes.parts import PlacedMarker, SceneParts
from fidsplat.scenes.read import read_scene
from fidsplat.scenes.surface import Surface
from fidsplat.scenes.up import scene_up
from fidsplat.scenes.write import write_scene
from fidsplat.util.arguments import instance
from fidsplat.util.markup import Summarised, point
from fidsplat.util.progress import Progress

if TYPE_CHECKING:
    from fidsplat.markers import Marker


class Scene(SceneParts, Summarised):
    """Splats, markers, camera and capture. Raises InputError for a field of the wrong type."""

    def __repr__(self) -> str:
        words = (f"{len(cloud):,} splats" for cloud in (*self.stores, *self.clouds))
        return f"Scene({', '.join([*words, *(placed.marker.spec for placed in self.markers)])})"

    def summary(self) -> dict[str, str]:
        """Content of the scene as text, by topic."""
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

        quality: replaces the quality of the file; its marker settings apply to markers without their own.
        progress: called with the current step and its fraction done, 0 to 1.

        Raises InputError with file and key.
        """
        return Scene(**read_scene(path, quality, progress))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a scene file, and next to it a PLY file STEM-splats-I.ply for each of ``clouds``.

        Raises InputError if a file cannot be written, or a marker cannot be expressed in a scene file.
        """
        write_scene(self, path)

    def surface_at(
        self,
        camera: Camera | None = None,
        pixel: Any = None,
        *,
        ray: Any = None,
        radius: float | None = None,
        renderer: Any = None,
        resident: Any = None,
    ) -> Surface:
        """Position and normal of the surface at a pixel or along a ray, from rendered depth; see
        `fs.surface_at`.

        Raises InputError if less than half of the patch is one plane, or the pixel is outside the image.
        """
        import fidsplat  # lazy: it imports the renderer, on which scenes do not depend

        return fidsplat.surface_at(
            self, camera, pixel, ray=ray, radius=radius, renderer=renderer, resident=resident
        )

    def place(
        self,
        marker: Marker,
        *,
        camera: Camera | None = None,
        pixel: Any = None,
        ray: Any = None,
        radius: float | None = None,
        up: Any = None,
        lift: float | None = None,
        bundle: str | None = None,
        light: Any = None,
        renderer: Any = None,
        resident: Any = None,
    ) -> Scene:
        """The scene with one more marker, upright on the surface at a pixel or along a ray.

        On floors and ceilings, the upper edge of the marker faces the top of the image. Warns if the scene
        has a tag or QR code of the same content.

        Args:
            marker: the marker.
            camera, pixel, ray: camera, by default the scene's, and (x, y) in its image; or a ray, see
                `fs.surface_at`.
            radius: radius of the patch of the surface [m]; None: of the marker with its quiet zone.
            up: (3,) vertical of the scene; None: as estimated by `fidsplat info`.
            lift: distance in front of the surface [m]; None: 1 mm plus twice the roughness.
            bundle, light: see `PlacedMarker`.
            renderer, resident: see `fs.surface_at`.

        Raises InputError if less than half of the patch is one plane, or the pixel is outside the image.
        """
        from fidsplat.markers import Marker  # lazy: heavy imports

        instance("marker", marker, Marker, "a Marker, e.g. fs.marker('apriltag:36h11:5', 0.16)")
        radius = marker.radius if radius is None else radius
        surface = self.surface_at(camera, pixel, ray=ray, radius=radius, renderer=renderer, resident=resident)
        coded = marker.id is not None or marker.payload is not None
        if coded and any(placed.marker.spec == marker.spec for placed in self.markers):
            warnings.warn(
                f"{marker.spec} is already in the scene: markers that occur more than once do not determine "
                "a pose; place another marker, or remove the first one",
                stacklevel=2,
            )
        if ray is not None:
            directions = [ray[1], *np.eye(3)]
        else:
            view = camera or self.camera
            assert view is not None  # checked by surface_at
            directions = [-view.world_to_camera[1, :3], view.world_to_camera[2, :3]]
        pose = surface.pose([scene_up(self) if up is None else up, *directions], lift)
        return replace(self, markers=(*self.markers, PlacedMarker(marker, pose, bundle=bundle, light=light)))
