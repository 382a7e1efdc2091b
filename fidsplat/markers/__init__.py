"""Markers of splats: parsing of specs, module grids, minimum rectilinear partitions, and mixtures of
Gaussians.

Names of this package are imported on first use, and shapely, segno and OpenCV when a marker needs them.
"""

from importlib import import_module

_HOME = {
    "BentSheet": "fidsplat.markers.surfaces",
    "BoxEdge": "fidsplat.markers.surfaces",
    "Cone": "fidsplat.markers.surfaces",
    "Crumpled": "fidsplat.markers.surfaces",
    "Cylinder": "fidsplat.markers.surfaces",
    "Kind": "fidsplat.markers.spec",
    "Marker": "fidsplat.markers.build",
    "Rectangle": "fidsplat.markers.build",
    "Spec": "fidsplat.markers.spec",
    "Wear": "fidsplat.markers.wear",
    "marker": "fidsplat.markers.build",
    "parse_spec": "fidsplat.markers.kinds",
    "register": "fidsplat.markers.kinds",
    "with_file": "fidsplat.markers.kinds",
}

__all__ = sorted(_HOME)


def __getattr__(name: str):
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module 'fidsplat.markers' has no attribute {name!r}")
    value = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
