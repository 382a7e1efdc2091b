"""`fidsplat store`."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from fidsplat.commands.options import Device, Json, Overwrite, check_range, option, parse_bytes, switch
from fidsplat.commands.output import console, delayed_progress, print_json, print_table, report
from fidsplat.util.errors import InputError, several
from fidsplat.util.files import writable_folder

if TYPE_CHECKING:
    import fidsplat as fs

Out = Annotated[str, option("OUT.fss", "store to write", "-o")]
StorePath = Annotated[tyro.conf.Positional[str], option("STORE.fss", "store to read")]


@dataclass
class Build:
    """Build a store of splat files of any size: spatially sorted chunks with levels of detail.

    PLY files are read in parts, so that memory is limited by --memory and not by the files; other formats are
    loaded completely. The same command resumes an interrupted build. Splats that cannot be rendered are left
    out and counted. While it is built, a store needs twice its size on the disk.

    Examples:
      fidsplat store build street.ply -o street.fss
      fidsplat store build block-*.ply -o city.fss --memory 1GiB --sh-degree 1 --colors float16
    """

    inputs: Annotated[tyro.conf.Positional[list[str]], option("IN...", "splat files")]
    out: Out
    chunk: Annotated[int, option("N", "maximum number of splats per chunk")] = 32768
    memory: Annotated[str, option("SIZE", "approximate memory while building")] = "2GiB"
    sh_degree: Annotated[
        int | None, option("N", "highest SH degree to store (default: that of the files)")
    ] = None
    colors: Annotated[str, option("TYPE", "type of colours and SH: float32 or float16")] = "float32"
    no_levels: Annotated[bool, switch("store no levels of detail; every image is then exact")] = False
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.store.build import build_store
        from fidsplat.store.store import Store

        memory, begun = parse_bytes("--memory", self.memory), time.perf_counter()
        assert memory is not None
        with delayed_progress() as progress:
            folder = build_store(
                self.inputs,
                self.out,
                chunk=self.chunk,
                memory=memory,
                levels=not self.no_levels,
                sh_degree=self.sh_degree,
                colors=self.colors,
                overwrite=self.overwrite,
                progress=progress,
            )
        seconds, store = time.perf_counter() - begun, Store(folder)
        facts = {"store": str(folder), "splats": len(store), "chunks": store.chunks, "bytes": store.nbytes}
        facts |= {"left_out": store.header.dropped, "seconds": seconds}
        words = f"{_splats(store)}, {store.nbytes / 2**20:.1f} MiB, "
        left = (f"dropped: {count:,}: {why}" for why, count in store.header.dropped.items())
        rate = len(store) / seconds / 1e6
        return report(self.json, facts, words + f"in {seconds:.1f} s ({rate:.2f} M/s): {folder}", *left)


@dataclass
class Place:
    """Place instances of a store: the new store holds only poses and the path of the other.

    Poses come from a file (camera to world, as for `fidsplat fly`) or form a grid whose first pose is that of
    the store itself.

    Examples:
      fidsplat store place house.fss -o street.fss --grid 10,1,2 --pitch 12,0,30
      fidsplat store place house.fss -o town.fss --poses houses.tum
    """

    source: StorePath
    out: Out
    grid: Annotated[str | None, option("NX,NY,NZ", "instances along the world's axes")] = None
    pitch: Annotated[str, option("DX,DY,DZ", "metres between instances")] = "10,10,10"
    poses: Annotated[str | None, option("FILE", "poses, for example TUM, instead of a grid")] = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.formats import load_trajectory
        from fidsplat.store.instances import place_store
        from fidsplat.store.store import Store

        if (self.grid is None) == (self.poses is None):
            raise InputError("give either --grid NX,NY,NZ or --poses FILE")
        if self.poses is not None:
            poses = list(load_trajectory(self.poses).poses)
        else:
            poses = _grid_poses(
                _parse_triple("--grid", self.grid, int), _parse_triple("--pitch", self.pitch, float)
            )
        store = Store(place_store(self.source, self.out, poses, overwrite=self.overwrite))
        facts = {"store": str(store.path), "places": store.instances, "splats": len(store)}
        return report(
            self.json,
            facts,
            f"{several(len(store), 'splats')} at {several(store.instances, 'places')}: {store.path}",
        )


def _splats(store: fs.Store) -> str:
    return f"{several(len(store), 'splats')} in {several(store.chunks, 'chunks')}"


def _parse_triple(name: str, text: str | None, kind: type) -> list:
    try:
        values = [kind(word) for word in str(text).split(",")]
        if len(values) != 3 or (kind is int and min(values) < 1) or not all(abs(v) < 1e9 for v in values):
            raise ValueError
    except ValueError:
        what = "three whole numbers of at least 1" if kind is int else "three lengths in metres"
        raise InputError(f"{name} must be {what}, got {text!r}; write for example 10,1,2") from None
    return values


def _grid_poses(counts: list[int], pitch: list[float]) -> list:
    import numpy as np

    if np.prod([float(count) for count in counts]) > 1e7:
        raise InputError(f"--grid must be at most 10,000,000 instances, got {' x '.join(map(str, counts))}")
    steps = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    poses = np.tile(np.eye(4), (len(steps), 1, 1))
    poses[:, :3, 3] = steps * pitch
    return list(poses)


@dataclass
class StoreInfo:
    """Describe a store: splats, chunks, levels of detail, bytes, bounds.

    Examples:
      fidsplat store info city.fss
      fidsplat store info city.fss --json
    """

    store: StorePath
    json: Json = False

    def run(self) -> int:
        return report_store(self.store, self.json)


def report_store(path: str, as_json: bool) -> int:
    """Describe a store; returns the exit status 0. Raises InputError for another kind of folder."""
    from fidsplat.store.store import Store

    facts = _facts(Store(path))
    return report(as_json, facts, table=(path, ("", ""), _rows(facts)))


def _facts(store: fs.Store) -> dict[str, Any]:
    import numpy as np

    nodes = store.nodes
    levels = [
        {
            "level": int(level),
            "nodes": int(np.count_nonzero(nodes["level"] == level)) * store.instances,
            "splats": int(nodes["count"][nodes["level"] == level].sum()) * store.instances,
            "cell_m": float(np.median(nodes["size"][nodes["level"] == level])),
        }
        for level in np.unique(nodes["level"])
    ]
    header = store.header
    facts = {"store": str(store.path), "splats": len(store), "kind": _KINDS[store.ellipsoids]}
    facts |= {"sh_degree": max(store.sh_degree, 0), "chunks": store.chunks, "places": store.instances}
    facts |= {"placed": header.store, "bytes": store.nbytes, "columns": dict(header.columns)}
    facts |= {"sources": list(header.sources), "left_out": dict(header.dropped), "levels": levels}
    return facts | {"bounds": list(store.bounds()) if len(store) else None}


_KINDS = {"none": "2D", "all": "3D", "some": "2D and 3D"}


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [("splats", f"{facts['splats']:,} ({facts['kind']}), SH degree {facts['sh_degree']}")]
    if facts["placed"] is not None:
        rows.append(("places", f"{facts['places']:,} of {facts['placed']}"))
    rows += [("chunks", f"{facts['chunks']:,}"), ("files", f"{facts['bytes'] / 2**20:.1f} MiB")]
    rows += [("made of", ", ".join(facts["sources"]))] if facts["sources"] else []
    rows += [("left out", f"{count:,}: {why}") for why, count in facts["left_out"].items()]
    rows += [
        (
            f"level {one['level']}",
            f"{several(one['splats'], 'splats')} in {several(one['nodes'], 'nodes')}, cells of "
            f"{one['cell_m']:.3g} m",
        )
        for one in facts["levels"]
        if one["level"]
    ]
    if facts["bounds"]:
        corners = ("(" + ", ".join(f"{value:.4g}" for value in corner) + ")" for corner in facts["bounds"])
        rows.append(("bounds", " to ".join(corners) + " m"))
    return rows


@dataclass
class Measure:
    """Measure the error of levels of detail against exact images.

    Renders random views around and inside the store at 320 x 180 pixels. The store keeps the errors, so that
    Quality.detail_error can select levels, with the same cut-off: fidsplat render city.fss --quality
    lowpass=pixel,alpha_cutoff=1e-8,detail_error=0.004
    The error holds on the measured views with a margin of 3. Other views may exceed it, the fewer the more
    views are measured.

    Examples:
      fidsplat store measure city.fss
      fidsplat store measure city.fss --views 40 --lowpass pixel,screen
    """

    store: StorePath
    views: Annotated[int, option("N", "number of viewpoints")] = 60
    lowpass: Annotated[str, option("A,B,...", "low-pass filters: pixel, screen, none")] = "pixel"
    seed: Annotated[int, option("N", "seed of the viewpoints")] = 0
    device: Device = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.accuracy.detail_errors import measure_detail

        store, names = fs.Store(self.store), [name.strip() for name in self.lowpass.split(",")]
        with delayed_progress() as progress:
            renderer = fs.Renderer(self.device)
            made = measure_detail(store, renderer, self.views, names, self.seed, progress)
        if self.json:
            print_json({"store": self.store, "details": [vars(one) for one in made]})
            return 0
        for one in made:
            rows = (
                (f"{size:.3f}", "not met" if error is None else f"{error:.4f}")
                for size, error in zip(one.sizes, one.errors, strict=True)
            )
            title = f"lowpass {one.lowpass}, level {one.level}, {one.views} views, {one.device}"
            print_table(console(False), title, ("cells up to [px]", "largest error of rgb"), rows)
        return 0


@dataclass
class StoreDemo:
    """Make a city of 20 million splats with measured levels of detail.

    DIR/city.fss is the store, DIR/city.toml a scene with a flight through a street and over the roofs.
    --markers places ArUco markers of 0.8 m on the walls of the houses, in the scene and not in the store.

    Examples:
      fidsplat store demo -o city
      fidsplat store demo -o city --markers 1000
      fidsplat fly city/city.toml -o flight --rate 2
    """

    out: Annotated[str, option("DIR", "folder", "-o")] = "fidsplat-city"
    splats: Annotated[float, option("N", "number of splats")] = 20e6
    houses: Annotated[int, option("N", "houses along a side")] = 8
    seed: Annotated[int, option("N", "seed of houses and splats")] = 0
    markers: Annotated[int, option("N", "markers on the walls, 0 to 1,000")] = 0
    views: Annotated[int, option("N", "viewpoints of the measurement, 0 for none")] = 24
    device: Device = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.accuracy.detail_errors import measure_detail
        from fidsplat.accuracy.error import REFERENCE_CUTOFF
        from fidsplat.worlds.city import City, flight

        if not (math.isfinite(self.splats) and self.splats == int(self.splats)):
            raise InputError(f"--splats must be a whole number, got {self.splats:g}")
        check_range("--views", self.views, 0, 10_000)
        check_range("--markers", self.markers, 0, 1000)
        city, folder = City(int(self.splats), self.houses, self.seed), writable_folder(self.out)
        begun = time.perf_counter()
        with delayed_progress() as progress:
            path = fs.build_store(
                [city.source], folder / "city.fss", overwrite=self.overwrite, progress=progress
            )
            store = fs.Store(path)
            if self.views and len(store.nodes) > store.chunks:
                measure_detail(store, fs.Renderer(self.device), self.views, progress=progress)
        camera, motion = flight(city)
        error = DEMO_ERROR if store.detail_errors else 0.0
        quality = fs.Quality(lowpass="pixel", alpha_cutoff=REFERENCE_CUTOFF, detail_error=error)
        scene = folder / "city.toml"
        poses = city.marker_poses(self.markers)
        placed = [
            fs.scenes.PlacedMarker(fs.marker(f"aruco:4x4_1000:{number}", size=0.8), pose)
            for number, pose in enumerate(poses)
        ]
        whole = fs.Scene(
            markers=placed, stores=(store,), camera=camera, camera_motion=motion, quality=quality
        )
        whole.save(scene)
        seconds = time.perf_counter() - begun
        facts = {"store": str(path), "scene": str(scene), "splats": len(store), "seconds": seconds}
        words = f"{_splats(store)}, in {seconds:.0f} s: {path}"
        return report(self.json, facts, words, f"fly through it: fidsplat fly {scene}")


DEMO_ERROR = 1 / 255
"""error of the demo's images, one step of 8 bits"""


@dataclass
class Verify:
    """Compare every chunk of a store with its checksum; the exit status is 1 if one is damaged.

    Examples:
      fidsplat store verify city.fss
    """

    store: StorePath
    json: Json = False

    def run(self) -> int:
        from fidsplat.store.store import Store

        store = Store(self.store)
        with delayed_progress() as progress:
            wrong = store.verify(progress)
        facts = {"store": self.store, "nodes": len(store.nodes), "damaged": wrong}
        report(
            self.json, facts, *(wrong or [f"{self.store} is complete: {several(len(store.nodes), 'nodes')}"])
        )
        return 1 if wrong else 0


@dataclass
class Store:
    """Build, place and describe stores: scenes on disk that may be larger than memory.

    Every command that reads a splat file also reads a store (docs/large-scenes.md).

    Examples:
      fidsplat store build street.ply -o street.fss
      fidsplat render street.fss
    """

    PARTS: ClassVar[dict[str, type]] = {
        "build": Build,
        "place": Place,
        "info": StoreInfo,
        "verify": Verify,
        "measure": Measure,
        "demo": StoreDemo,
    }
