"""Fiducial markers made of 2D Gaussian splats, and the 2DGS rasterizer that renders them.

Names are loaded on first use, so that ``import fidsplat`` imports no OpenCL, shapely, networkx or cv2.
"""

from importlib import import_module

TYPE_CHECKING = False  # typing would take most of the time of `import fidsplat`
if TYPE_CHECKING:
    from typing import Any

__version__ = "0.1.0"

_HOME = {
    "SplatCloud": "fidsplat.splats.cloud",
    "Camera": "fidsplat.cameras",
    "Capture": "fidsplat.capture.capture",
    "BrownConrady": "fidsplat.cameras",
    "Fisheye": "fidsplat.cameras",
    "Equirectangular": "fidsplat.cameras",
    "Orthographic": "fidsplat.cameras",
    "Shutter": "fidsplat.cameras",
    "Motion": "fidsplat.cameras",
    "Trajectory": "fidsplat.cameras",
    "Scene": "fidsplat.scenes",
    "Lighting": "fidsplat.scenes.lights",
    "PointLight": "fidsplat.scenes.lights",
    "SpotLight": "fidsplat.scenes.lights",
    "Sun": "fidsplat.scenes.lights",
    "fetch_scene": "fidsplat.scenes.captured",
    "MarkerQuality": "fidsplat.capture.quality",
    "Quality": "fidsplat.capture.quality",
    "quality_within": "fidsplat.accuracy.quality_within",
    "Sensor": "fidsplat.capture.sensor",
    "Fog": "fidsplat.capture.environment",
    "Gradient": "fidsplat.capture.environment",
    "ExternalDepth": "fidsplat.capture.environment",
    "Panorama": "fidsplat.capture.environment",
    "Marker": "fidsplat.markers",
    "marker": "fidsplat.markers",
    "load_ply": "fidsplat.formats",
    "save_ply": "fidsplat.formats",
    "load_splats": "fidsplat.formats",
    "save_splats": "fidsplat.formats",
    "load_cameras": "fidsplat.formats",
    "load_trajectory": "fidsplat.formats",
    "save_trajectory": "fidsplat.formats",
    "Store": "fidsplat.store.store",
    "build_store": "fidsplat.store.build",
    "place_store": "fidsplat.store.instances",
    "Renderer": "fidsplat.render.renderer",
    "SeveralDevices": "fidsplat.render.multi_device",
    "Frame": "fidsplat.render.frame",
    "DifferentiableFrame": "fidsplat.render.differentiable_frame",
    "FrameBatch": "fidsplat.render.frame",
    "Surface": "fidsplat.scenes.surface",
    "surface_at": "fidsplat.render.surface",
    "Lidar": "fidsplat.capture.lidar",
    "Scan": "fidsplat.render.scan",
    "scan": "fidsplat.render.scan",
    "scan_batch": "fidsplat.render.scan",
    "scene_mesh": "fidsplat.render.mesh",
    "localise": "fidsplat.localisation.localise",
    "Localisation": "fidsplat.localisation.localise",
    "devices": "fidsplat.backends",
    "FidsplatError": "fidsplat.util.errors",
    "InputError": "fidsplat.util.errors",
    "DeviceError": "fidsplat.util.errors",
}

_PACKAGES = ("train",)
"""packages that are names of their own, as fs.train.Trainer"""

__all__ = ["__version__", *sorted(_HOME), *_PACKAGES]


def __getattr__(name: str) -> "Any":
    if name in _PACKAGES:
        return import_module(f"fidsplat.{name}")
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module 'fidsplat' has no attribute {name!r}")
    value = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME, *_PACKAGES})
