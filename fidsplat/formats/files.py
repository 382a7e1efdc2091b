"""Reading and writing of splat files of all formats, selected by suffix."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.formats.gltf import load_gltf, save_gltf
from fidsplat.formats.ply import load_ply, save_ply
from fidsplat.formats.sog import load_sog, load_sog_folder, save_sog, save_sog_folder
from fidsplat.formats.sog_streamed import META, load_streamed
from fidsplat.formats.splat import load_splat, save_splat
from fidsplat.formats.spz import load_spz, save_spz
from fidsplat.formats.usd import load_usd, save_usd
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.arguments import instance
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import path_of, read_input
from fidsplat.util.progress import Progress


@dataclass(frozen=True)
class Format:
    """Reader, writer and limitations of a file format."""

    name: str
    load: Callable[[Path], SplatCloud]
    save: Callable[[SplatCloud, Path], None] | None
    """None for read-only formats"""
    labels: bool = False
    coplanar_groups: bool = False
    harmonics: bool = True
    origin: bool = False
    rounds: str = ""
    """values with fewer bits than float32, for `losses`"""


_SOG_ROUNDS = "positions to 16 bits, the rest to 8; SH above degree 0 to 65,536 sets"
_USD = Format("OpenUSD ParticleField", load_usd, save_usd, labels=True, coplanar_groups=True)
_GLTF = Format("glTF KHR_gaussian_splatting", load_gltf, save_gltf, labels=True, coplanar_groups=True)
FORMATS = {
    ".ply": Format("PLY", load_ply, save_ply, labels=True, coplanar_groups=True, origin=True),
    ".splat": Format(
        ".splat", load_splat, save_splat, harmonics=False, rounds="colours, opacities and rotations to 8 bits"
    ),
    ".spz": Format(
        "SPZ",
        load_spz,
        save_spz,
        labels=True,
        coplanar_groups=True,
        rounds="positions to 24 bits, rotations to 10, colours, opacities, scales and SH to 8 bits",
    ),
    ".glb": _GLTF,
    ".gltf": _GLTF,
    ".usda": _USD,
    ".usdc": _USD,
    ".usd": _USD,
    ".sog": Format("SOG", load_sog, save_sog, rounds=_SOG_ROUNDS),
}
"""formats by suffix"""
NAMED = {
    "meta.json": Format("SOG", load_sog_folder, save_sog_folder, rounds=_SOG_ROUNDS),
    META: Format("streamed SOG", load_streamed, None),
}
"""formats by file name"""
_UNREAD = {
    **dict.fromkeys((".ksplat", ".lcc", ".lcc2"), "convert it with splat-transform"),
    ".ckpt": "convert it by ns-export gaussian-splat of nerfstudio",
    ".pt": "convert it by gsplat.export_splats",
    ".spx": "convert it by gsbox",
    ".toml": "fidsplat render, view, fly and Scene.load read scene files",
    ".usdz": "extract it by unzip",
}
"""remedies for files that are not read, by suffix"""
_MAGIC = {b"ply": ".ply", b"NGSP": ".spz", b"glTF": ".glb", b"#usda": ".usda", b"PXR-USDC": ".usdc"}
"""first bytes of files of a format"""


def stored_bytes(path: str | os.PathLike[str]) -> int:
    """Size of a splat file in bytes, including the files that a JSON file (SOG, glTF) references."""
    path = Path(path)
    size = path.stat().st_size
    if path.suffix.lower() in (".json", ".gltf"):
        named = {
            path.parent / name for name in re.findall(r'"([^"\n]{1,200}\.\w{2,4})"', path.read_text("utf-8"))
        }
        size += sum(stored_bytes(file) for file in named - {path} if file.is_file())
    return size


def remedy_for(path: Path) -> str:
    """End of a message about a file or folder that is not read: how to convert it, or what to name."""
    suffix = path.suffix.lower()
    if path.is_dir():
        with suppress(OSError):
            names = [
                file
                for file in sorted(path.iterdir())
                if file.name in NAMED or file.suffix.lower() in FORMATS
            ]
            return f"; name a file in the folder, such as {names[0]}" if names else ""
    if suffix in _UNREAD:
        return f"; {_UNREAD[suffix]}"
    head = read_input(path, first=8) if path.is_file() else b""
    content = next((suffix for magic, suffix in _MAGIC.items() if head.startswith(magic)), suffix)
    if FORMATS.get(content) is FORMATS.get(suffix):
        return ""
    return f"; its content is {FORMATS[content].name}: rename it to {path.stem}{content}"


def format_of(path: str | os.PathLike[str]) -> Format:
    """Format of a file by its name or suffix. Raises InputError for an unknown format."""
    if (named := NAMED.get(path_of(path).name.lower())) is not None:
        return named
    suffix = path_of(path).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{path}: {unknown('suffix of a splat file', suffix, FORMATS)}")
    return FORMATS[suffix]


def load_splats(path: str | os.PathLike[str], progress: Progress | None = None) -> SplatCloud:
    """Read a splat file: .ply, .splat, .spz, .glb, .gltf, .usda, .usdc, .usd, .sog or meta.json.

    progress: callback with the current task and its completed fraction, 0 to 1; PLY only.

    Raises InputError for an unknown suffix or a damaged file.
    """
    file = path_of(path)
    try:
        known = format_of(file)
        return load_ply(file, progress) if known.load is load_ply else known.load(file)
    except InputError as error:
        message, remedy = str(error), remedy_for(file)
        if not remedy and ";" not in message and file.is_file():
            remedy = "; export the splats again, or copy the file again"
        raise InputError(message + remedy) from error


def save_splats(cloud: SplatCloud, path: str | os.PathLike[str]) -> None:
    """Write splats in the format of the file's suffix; `losses` lists data that this format cannot store.

    Raises InputError for an unknown or read-only suffix, boxes, or a file that cannot be written.
    """
    instance("cloud", cloud, SplatCloud)
    save = check_writable(path).save
    assert save is not None
    save(cloud, path_of(path))


def check_writable(path: str | os.PathLike[str]) -> Format:
    """Format of an output file. Raises InputError for an unknown or read-only format."""
    known = format_of(path)
    if known.save is None:
        others = ", ".join(suffix for suffix, other in FORMATS.items() if other.save is not None)
        raise InputError(
            f"{path}: {known.name} must be written from a store (`fidsplat store build`), got splats; write "
            f"{others}"
        )
    return known


def losses(cloud: SplatCloud, path: str | os.PathLike[str]) -> list[str]:
    """Descriptions of the data of a cloud that a file's format loses; empty for a lossless round trip."""
    known, descriptions = format_of(path), []
    if cloud.sh_degree > 0 and not known.harmonics:
        descriptions.append(f"SH of degree {cloud.sh_degree}: colours do not change with the view")
    if cloud.labels.any() and not known.labels:
        descriptions.append(f"labels ({len(np.unique(cloud.labels))} different)")
    if cloud.coplanar_groups is not None and not known.coplanar_groups:
        descriptions.append("coplanar groups: the splats are sorted by depth only")
    if cloud.origin.any() and not known.origin:
        means = cloud.world_means()
        off = float(np.abs(means - means.astype(np.float32)).max(initial=0.0))
        descriptions.append(f"the origin: positions are rounded by up to {off:.2g} m")
    return descriptions + ([f"rounds {known.rounds}"] if known.rounds else [])
