"""City of `fidsplat store demo`: a store with measured levels of detail, and a scene with a flight."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from fidsplat.capture.quality import Quality
from fidsplat.markers import marker
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.store.build import build_store
from fidsplat.store.store import Store
from fidsplat.util.arguments import whole_number
from fidsplat.util.files import writable_folder
from fidsplat.util.progress import Progress, no_progress
from fidsplat.worlds.city import City, flight

IMAGE_ERROR = 1 / 255
"""allowed error of images: one 8-bit level"""


@dataclass(frozen=True)
class CityDemoSettings(City):
    """A city with markers and measured levels of detail.

    Raises:
        InputError: numbers out of range.
    """

    markers: int = 0
    """markers on the walls, 0 to 1,000"""
    views: int = 24
    """viewpoints of the measurement of errors, 0 for none"""

    def __post_init__(self) -> None:
        super().__post_init__()
        whole_number("--markers", self.markers, 0, 1000)
        whole_number("--views", self.views, 0, 10_000)


def write_city(
    folder: str | os.PathLike[str],
    settings: CityDemoSettings,
    device: str | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> tuple[Store, Path]:
    """Write city.fss, and city.toml with a flight and markers; returns the store and the scene file."""
    from fidsplat.accuracy.detail_errors import measure_detail
    from fidsplat.accuracy.error import REFERENCE_CUTOFF
    from fidsplat.render.renderer import Renderer

    city, place = City(settings.splats, settings.houses, settings.seed), writable_folder(folder)
    store = Store(build_store([city.source], place / "city.fss", overwrite=overwrite, progress=progress))
    if settings.views and len(store.nodes) > store.chunks:
        measure_detail(store, Renderer(device), views=settings.views, progress=progress)
    camera, motion = flight(city)
    error = IMAGE_ERROR if store.detail_errors else 0.0
    scene = Scene(
        markers=tuple(
            PlacedMarker(marker(f"aruco:4x4_1000:{number}", size=0.8), pose)
            for number, pose in enumerate(city.marker_poses(settings.markers))
        ),
        stores=(store,),
        camera=camera,
        camera_motion=motion,
        quality=Quality(lowpass="pixel", alpha_cutoff=REFERENCE_CUTOFF, detail_error=error),
    )
    scene.save(place / "city.toml")
    return store, place / "city.toml"
