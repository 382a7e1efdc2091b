"""Triangle meshes, and writing of them as glTF, PLY, OBJ, STL, or a MuJoCo model of convex parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.formats.convex_parts import MAX_PARTS, ConvexPart, convex_parts
from fidsplat.formats.gltf import gltf_document, pack_glb
from fidsplat.formats.ply_header import header_bytes
from fidsplat.util.errors import InputError, required_package
from fidsplat.util.files import write_file
from fidsplat.util.response import linear_light

MESH_FORMATS = (".glb", ".ply", ".obj", ".stl", ".xml")
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles with colours at their vertices."""

    vertices: np.ndarray
    """(n, 3) float64 world metres"""
    faces: np.ndarray
    """(m, 3) int32 indices of vertices, counter-clockwise from outside"""
    colors: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    """(n, 3) RGB in display space, 0 to 1; empty for a mesh without colours"""

    @property
    def area(self) -> float:
        """Surface area in square metres."""
        return float(np.linalg.norm(self._crosses, axis=1).sum() / 2)

    @property
    def volume(self) -> float:
        """Enclosed volume of a closed mesh in cubic metres."""
        return float((self.vertices[self.faces[:, 0]] * self._crosses).sum() / 6)

    @property
    def closed(self) -> bool:
        """Whether each edge belongs to exactly two triangles, in opposite directions."""
        edges = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
        keys = np.sort(edges[:, 0] * len(self.vertices) + edges[:, 1])
        opposite = np.sort(edges[:, 1] * len(self.vertices) + edges[:, 0])
        return bool((keys[1:] > keys[:-1]).all() and np.array_equal(keys, opposite))

    @property
    def _crosses(self) -> np.ndarray:
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    def simplified(self, faces: int) -> TriangleMesh:
        """Simplify to at most this many faces by quadric error metrics. A vertex gets the mean colour of the
        vertices that were merged into it.

        Raises:
            InputError: the package fast-simplification is missing, or faces is below 4.
        """
        if faces < 4:
            raise InputError(f"--faces must be at least 4, got {faces}")
        if len(self.faces) <= faces:
            return self
        simplification = _package("fast_simplification")
        center = self.vertices.mean(0)
        local = (self.vertices - center).astype(np.float32)
        points, triangles, collapses = simplification.simplify(
            local, self.faces.astype(np.int32), target_count=faces, return_collapses=True
        )
        colors = self.colors
        if len(colors):
            _, _, where = simplification.replay_simplification(local, self.faces.astype(np.int32), collapses)
            remaining = where >= 0
            where, colors = where[remaining], colors[remaining]
            counts = np.bincount(where, minlength=len(points))[:, None]
            sums = np.stack([np.bincount(where, colors[:, k], len(points)) for k in range(3)], 1)
            colors = sums / np.maximum(counts, 1)
        return TriangleMesh(points + center, triangles.astype(np.int32), colors)


def save_mesh(mesh: TriangleMesh, path: Path, parts: int = MAX_PARTS) -> list[ConvexPart]:
    """Write a mesh in the format of the file's suffix; returns the convex parts of .xml.

    .glb has colours and y up, .ply has colours; .xml is a MuJoCo model of at most `parts` convex parts.

    Raises InputError for another suffix, an empty mesh, or a file that cannot be written.
    """
    suffix = check_mesh_file(path).suffix.lower()
    if not len(mesh.faces):
        raise InputError(
            "a mesh must have at least one triangle, got none; set other cameras or another voxel size"
        )
    if suffix == ".xml":
        hulls = convex_parts(mesh.vertices, mesh.faces, parts)
        write_file(path, _mujoco(hulls, path.stem))
        return hulls
    writer = {".glb": _glb, ".ply": _ply, ".obj": _obj, ".stl": _stl}[suffix]
    write_file(path, writer(mesh))
    return []


def check_mesh_file(path: Path) -> Path:
    """Validate the path of a mesh before it is computed. Raises InputError for an unknown suffix."""
    if path.suffix.lower() not in MESH_FORMATS:
        raise InputError(f"the suffix of a mesh must be {', '.join(MESH_FORMATS)}, got {path}")
    return path


def _mujoco(parts: list[ConvexPart], name: str) -> str:
    """MuJoCo model of one static body; MuJoCo computes the hulls of the vertices."""
    assets, geoms = [], []
    for number, part in enumerate(parts):
        values = " ".join(f"{value:.6g}" for value in part.vertices.ravel())
        assets.append(f'    <mesh name="{name}-{number}" inertia="convex" vertex="{values}"/>')
        geoms.append(f'      <geom type="mesh" mesh="{name}-{number}"/>')
    lines = [f'<mujoco model="{name}">', "  <asset>", *assets, "  </asset>", "  <worldbody>"]
    lines += [f'    <body name="{name}">', *geoms, "    </body>", "  </worldbody>", "</mujoco>", ""]
    return "\n".join(lines)


def _glb(mesh: TriangleMesh) -> bytes:
    points, faces = mesh.vertices.astype("<f4"), mesh.faces.astype("<u4")
    arrays = [(faces.reshape(-1, 1), 5125), (points, 5126)]
    if len(mesh.colors):
        linear = linear_light(np.clip(mesh.colors, 0, 1), "srgb")  # glTF requires linear colours
        arrays.append((linear.astype("<f4"), 5126))
    attributes = {"POSITION": 1} | ({"COLOR_0": 2} if len(mesh.colors) else {})
    document, binary = gltf_document(
        arrays, {"attributes": attributes, "indices": 0, "material": 0}, "fidsplat"
    )
    document["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}]
    document["accessors"][1] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    return pack_glb(document, binary)


def _ply(mesh: TriangleMesh) -> bytes:
    columns: list[Any] = [(name, "<f4") for name in "xyz"]
    colored = len(mesh.colors) > 0
    columns += [(name, "u1") for name in ("red", "green", "blue")] if colored else []
    rows = np.empty(len(mesh.vertices), columns)
    for k, name in enumerate("xyz"):
        rows[name] = mesh.vertices[:, k]
    if colored:
        rounded = np.clip(np.rint(255 * mesh.colors), 0, 255)
        for k, name in enumerate(("red", "green", "blue")):
            rows[name] = rounded[:, k]
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = header_bytes(
        ("vertex", len(rows), {name: rows.dtype[name].str[1:] for name in rows.dtype.names or ()}),
        ("face", len(faces), {"vertex_indices": "list uchar int"}),
    )
    return header + rows.tobytes() + faces.tobytes()


def _obj(mesh: TriangleMesh) -> bytes:
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()


def _stl(mesh: TriangleMesh) -> bytes:
    rows = np.zeros(len(mesh.faces), _STL)
    rows["corners"] = mesh.vertices[mesh.faces]
    crosses = mesh._crosses
    rows["normal"] = crosses / np.maximum(np.linalg.norm(crosses, axis=1, keepdims=True), 1e-30)
    return bytes(80) + np.array([len(rows)], "<u4").tobytes() + rows.tobytes()


def _package(module: str) -> Any:
    from importlib import import_module

    with required_package(module, "mesh"):
        return import_module(module)
