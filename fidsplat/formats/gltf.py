"""Reading and writing of glTF with KHR_gaussian_splatting (.glb, .gltf): lossless float32 values.

Extension: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting, release candidate. glTF has y up,
z forward and x to the left: splats are written unchanged below a node that rotates them by 180 degrees about
z, like splat-transform and nianticlabs/spz. Reading applies the transforms of all parent nodes and the
inverse rotation.
"""

from __future__ import annotations

import base64
import binascii
import codecs
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from fidsplat.formats.plain import (
    HALF_TURN,
    cloud_of,
    coefficients,
    content,
    neighbour,
    refuse_boxes,
    three_scales,
    world_means,
)
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError, damaged_data
from fidsplat.util.files import from_json, read_input, write_file
from fidsplat.util.limits import check_expansion

EXTENSION = "KHR_gaussian_splatting"
_COLOR_SPACE = "srgb_rec709_display"
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_TO_GLTF = np.diag([-1.0, -1.0, 1.0, 1.0])
"""rotation by 180 degrees about z, its own inverse"""
_COPIES = 3
"""copies of each value in memory while a file is read: accessor, cloud, transformed cloud"""
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def load_gltf(path: Path) -> SplatCloud:
    """Read the splats of all nodes of a .glb or .gltf file as one cloud.

    Raises:
        InputError: the file is damaged, has no splats or references a file outside its folder, or a node has
            a non-uniform scale or a reflection.
    """
    data = content(path, (b"glTF", b"{", codecs.BOM_UTF8))
    document, binary = _parts(path, data)
    with damaged_data(f"{path}: the glTF file"):
        clouds = _Reader(path, document, binary).clouds()
    if not clouds:
        used = ", ".join(map(str, document.get("extensionsUsed") or ["none"]))
        raise InputError(
            f"{path} must have splats, got no primitive with {EXTENSION} (extensions: {used}); export them "
            "again with splat-transform"
        )
    return clouds[0] if len(clouds) == 1 else SplatCloud.concatenate(clouds)


def save_gltf(cloud: SplatCloud, path: Path) -> None:
    """Write a .glb file, or a .gltf file with embedded data. The application-specific attributes _LABEL and
    _PLANE contain labels and coplanar groups.

    Raises InputError for boxes or a file that cannot be written.
    """
    refuse_boxes(cloud, "glTF")
    if not len(cloud):
        raise InputError("a cloud in glTF must have at least one splat, got none")
    means, sh = world_means(cloud), coefficients(cloud)
    prefix = f"{EXTENSION}:"
    arrays = {"POSITION": means, f"{prefix}ROTATION": cloud.quats[:, [1, 2, 3, 0]]}
    arrays |= {f"{prefix}SCALE": three_scales(cloud), f"{prefix}OPACITY": cloud.opacities[:, None]}
    for k in range(sh.shape[1]):
        degree = int(np.sqrt(k))
        arrays[f"{prefix}SH_DEGREE_{degree}_COEF_{k - degree * degree}"] = sh[:, k]
    for name, integers in (
        ("label", cloud.labels if cloud.labels.any() else None),
        ("plane", cloud.coplanar_groups),
    ):
        if integers is None:
            continue
        if (largest := np.abs(integers.astype(np.int64)).max()) >= 2**24:
            raise InputError(
                f"{name}s in glTF must be less than 2^24, since they are floats, got {largest}; "
                "use smaller ones"
            )
        arrays[f"_{name.upper()}"] = integers[:, None].astype(np.float32)
    document, binary = gltf_document(
        [(array, 5126) for array in arrays.values()], _primitive(list(arrays)), "fidsplat, z forward"
    )
    document |= {"extensionsUsed": [EXTENSION]}
    document["accessors"][0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    if path.suffix.lower() == ".gltf":
        uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode("ascii")
        document["buffers"][0]["uri"] = uri
        out = json.dumps(document).encode()
    else:
        out = pack_glb(document, binary)
    write_file(path, out)


def _primitive(names: list[str]) -> dict[str, Any]:
    splats = {"kernel": "ellipse", "colorSpace": _COLOR_SPACE}
    return {
        "mode": 0,
        "attributes": {name: k for k, name in enumerate(names)},
        "extensions": {EXTENSION: splats | {"projection": "perspective", "sortingMethod": "cameraDistance"}},
    }


def gltf_document(
    arrays: list[tuple[np.ndarray, int]], primitive: dict[str, Any], generator: str
) -> tuple[dict[str, Any], bytes]:
    """Document and binary data of one primitive below a rotation by 180 degrees about z.

    arrays: (n, width) little-endian values of each accessor, and their component type.
    """
    views, accessors, chunks, offset = [], [], [], 0
    kinds = {width: name for name, width in _WIDTHS.items()}
    for array, component in arrays:
        chunk = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(chunk)})
        accessor = {"bufferView": len(accessors), "componentType": component}
        accessors.append(accessor | {"count": len(array), "type": kinds[array.shape[1]]})
        chunks.append(chunk)
        offset += len(chunk)
    document = {
        "asset": {"version": "2.0", "generator": generator},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [0.0, 0.0, 1.0, 0.0]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    return document, b"".join(chunks)


def pack_glb(document: dict[str, Any], binary: bytes) -> bytes:
    """Content of a .glb file with a document and its binary data."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<III", _MAGIC, 2, size) + struct.pack("<II", len(text), _JSON)
    return head + text + struct.pack("<II", len(binary), _BIN) + binary


def _check_version(path: Path, version: str) -> None:
    if version.partition(".")[0] != "2":
        raise InputError(
            f"{path}: the version of glTF must be 2, got {version}; convert it by gltf-pipeline, or export "
            "it again with splat-transform"
        )


def _parts(path: Path, data: bytes) -> tuple[dict[str, Any], memoryview | None]:
    """JSON document, and a view of the binary chunk of a .glb file (None for .gltf)."""
    text, binary = data, None
    if data[:4] == b"glTF":
        version, size = (int.from_bytes(data[at : at + 4], "little") for at in (4, 8))
        if len(data) >= 8:
            _check_version(path, str(version))
        chunks, place = {}, 12
        while place + 8 <= min(size, len(data)):
            length, kind = struct.unpack_from("<II", data, place)
            chunks.setdefault(kind, memoryview(data)[place + 8 : place + 8 + length])
            place += 8 + length
        if size > len(data) or _JSON not in chunks:
            raise InputError(f"cannot read {path} as binary glTF of version 2: truncated or damaged")
        text, binary = bytes(chunks[_JSON]), chunks.get(_BIN)
    try:
        document = from_json(text)
    except ValueError:
        raise InputError(f"cannot read {path} as glTF: not JSON") from None
    if not isinstance(document, dict):
        raise InputError(f"cannot read {path} as glTF: not a JSON object")
    return document, binary


class _Reader:
    """Reader of the splats of a glTF document."""

    def __init__(self, path: Path, document: dict[str, Any], binary: memoryview | None) -> None:
        self._path, self._document, self._binary = path, document, binary
        self._buffers: dict[int, bytes | memoryview] = {}
        self._visited: set[int] = set()

    def clouds(self) -> list[SplatCloud]:
        _check_version(self._path, str(self._document.get("asset", {}).get("version", "2.0")))
        scenes = self._document.get("scenes")
        roots = (
            scenes[self._document.get("scene", 0)].get("nodes", [])
            if scenes
            else range(len(self._document.get("nodes", [])))
        )
        # early versions of fidsplat wrote a rotation about x
        axes = HALF_TURN if self._document.get("asset", {}).get("generator") == "fidsplat" else _TO_GLTF
        placed = [pair for root in roots for pair in self._below(root, axes)]
        self._check_expansion([primitive for primitive, _ in placed])
        cloud_of_primitive: dict[int, SplatCloud] = {}  # by id of the primitive, since nodes may share a mesh
        for primitive, _ in placed:
            if id(primitive) not in cloud_of_primitive:
                cloud_of_primitive[id(primitive)] = self._cloud(primitive)
        return [
            cloud_of_primitive[id(primitive)]
            if np.abs(matrix - np.eye(4)).max() < 1e-12
            else cloud_of_primitive[id(primitive)].transformed(matrix)
            for primitive, matrix in placed
        ]

    def _below(self, number: int, above: np.ndarray) -> list[tuple[dict[str, Any], np.ndarray]]:
        """Splat primitives of a node and its descendants, with their poses (4, 4)."""
        if number in self._visited:
            raise InputError(
                f"{self._path}: node {number} must have one parent and not be its own descendant, got two "
                "paths to it"
            )
        self._visited.add(number)
        node = self._document["nodes"][number]
        matrix = above @ _matrix(node)
        primitives = []
        if "mesh" in node:
            for primitive in self._document["meshes"][node["mesh"]]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    primitives.append((primitive, matrix))
        return primitives + [
            pair for child in node.get("children", []) for pair in self._below(child, matrix)
        ]

    def _cloud(self, primitive: dict[str, Any]) -> SplatCloud:
        kernel = primitive["extensions"][EXTENSION].get("kernel", "ellipse")
        if kernel != "ellipse":
            raise InputError(f"{self._path}: the kernel must be ellipse, got {kernel!r}")
        space = primitive["extensions"][EXTENSION].get("colorSpace", _COLOR_SPACE)
        if space != _COLOR_SPACE:
            raise InputError(f"{self._path}: the colour space must be {_COLOR_SPACE}, got {space!r}")
        attributes, prefix = primitive["attributes"], f"{EXTENSION}:"
        if primitive["extensions"][EXTENSION].get("extensions"):
            raise InputError(
                f"{self._path}: splats must be uncompressed, got a compression extension; export without it, "
                "or convert the original SPZ or SOG file"
            )
        arrays = {
            name: self._array(number, plain=name == f"{prefix}SCALE")
            for name, number in attributes.items()
            if name != "COLOR_0"
        }
        count = sum(name.startswith(f"{prefix}SH_DEGREE_") for name in arrays)
        names = [f"{prefix}SH_DEGREE_{(d := int(np.sqrt(k)))}_COEF_{k - d * d}" for k in range(count)]
        sh = np.stack([arrays[name] for name in names], axis=1)
        labels, groups = (self._integers(arrays, name) for name in ("_LABEL", "_PLANE"))
        quats = arrays[f"{prefix}ROTATION"][:, [3, 0, 1, 2]]
        scales, opacities = arrays[f"{prefix}SCALE"], arrays[f"{prefix}OPACITY"][:, 0]
        return cloud_of(
            self._path,
            arrays["POSITION"],
            quats,
            scales,
            opacities,
            sh,
            labels=labels,
            coplanar_groups=groups,
        )

    def _check_expansion(self, primitives: list[dict[str, Any]]) -> None:
        """Check that all primitives fit in memory as separate arrays: nodes may share a mesh, and attributes
        an accessor."""
        accessors = [
            self._document["accessors"][number]
            for primitive in primitives
            for number in primitive["attributes"].values()
        ]
        need = sum(_COPIES * 4 * _WIDTHS[accessor["type"]] * int(accessor["count"]) for accessor in accessors)
        size = sum(len(self._buffer(number)) for number in range(len(self._document.get("buffers", []))))
        check_expansion(self._path, need, "its nodes with all their attributes", size)

    def _integers(self, arrays: dict[str, np.ndarray], name: str) -> np.ndarray | None:
        """(n,) int32 of an optional attribute that stores integers as floats."""
        if name not in arrays:
            return None
        values = arrays[name][:, 0]
        wrong = values[~(np.abs(values) < 2**24) | (values % 1 != 0)]
        if len(wrong):
            raise InputError(
                f"{self._path}: the attribute {name} must have whole numbers below 2^24, got {wrong[0]:.9g}; "
                "export the file with smaller ids, or without them"
            )
        return values.astype(np.int32)

    def _array(self, number: int, plain: bool = False) -> np.ndarray:
        """Values (n, width) float32 of an accessor. plain: accept integers that are not normalized."""
        accessor = self._document["accessors"][number]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise InputError(f"{self._path}: accessor {number} must be dense, got a sparse one")
        view = self._document["bufferViews"][accessor["bufferView"]]
        kind, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        row, count = kind.itemsize * width, int(accessor["count"])
        stride, first = view.get("byteStride", row), accessor.get("byteOffset", 0)
        start = view.get("byteOffset", 0) + first
        data = self._buffer(view["buffer"])
        need = start + (count - 1) * stride + row
        if min(count, start + 1, stride) < 1 or need > len(data) or need > start - first + view["byteLength"]:
            raise InputError(f"{self._path}: truncated: accessor {number} exceeds its buffer")
        values = np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))
        if kind.kind == "f":
            return values.copy()
        if plain and not accessor.get("normalized"):
            return values.astype(np.float32)
        if not accessor.get("normalized"):
            raise InputError(f"{self._path}: accessor {number} must be normalized, got plain {kind.name}")
        return np.maximum(values.astype(np.float32) / np.iinfo(kind).max, -1)

    def _buffer(self, number: int) -> bytes | memoryview:
        if number not in self._buffers:
            buffer = self._document["buffers"][number]
            self._buffers[number] = self._read(buffer.get("uri"), number)
        return self._buffers[number]

    def _read(self, uri: str | None, number: int) -> bytes | memoryview:
        if uri is None:
            if self._binary is None or number:
                raise InputError(f"{self._path}: buffer {number} must have data, got none")
            return self._binary
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error:
                raise InputError(f"{self._path}: buffer {number} is damaged: it is not base64") from None
        file = neighbour(self._path, unquote(uri))
        views = [view for view in self._document["bufferViews"] if view["buffer"] == number]
        size = max(int(view.get("byteOffset", 0)) + int(view["byteLength"]) for view in views)
        return read_input(file, first=max(size, 0))  # only the referenced bytes of a larger file


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    scale = np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    return rigid_matrix(node.get("translation", (0.0, 0.0, 0.0)), (w, x, y, z)) @ np.diag([*scale, 1.0])
