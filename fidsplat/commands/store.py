"""`fidsplat store`."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from fidsplat.commands.output import (
    Device,
    Json,
    Overwrite,
    bytes_of,
    console,
    late_progress,
    option,
    print_json,
    print_table,
    switch,
    tell,
)
from fidsplat.util.errors import InputError, several
from fidsplat.util.files import writable_folder

if TYPE_CHECKING:
    import fidsplat as fs

Out = Annotated[str, option("OUT.fss", "the store to write", "-o")]
StorePath = Annotated[tyro.conf.Positional[str], option("STORE.fss", "a store")]


@dataclass
class Build:
    """Build a store of splat files of any size: splats in a spatial order, in chunks, with levels of detail.

    PLY files are read in parts, so memory follows --memory and not the files; other formats are loaded. A
    build that is stopped, or whose disk was full, goes on where it was when the same command is given again.
    Splats that cannot be drawn are left out and counted. Beside the store as much room again is needed while
    it is built.

    Examples:
      fidsplat store build street.ply -o street.fss
      fidsplat store build block-*.ply -o city.fss --memory 1GiB --sh-degree 1 --colors float16
    """

    inputs: Annotated[tyro.conf.Positional[list[str]], option("IN...", "splat files")]
    out: Out
    chunk: Annotated[int, option("N", "splats of a chunk, at most (default: 32768)")] = 32768
    memory: Annotated[str, option("SIZE", "to take while building, roughly (default: 2GiB)")] = "2GiB"
    sh_degree: Annotated[int | None, option("N", "highest degree of SH to keep (default: the files')")] = None
    colors: Annotated[str, option("TYPE", "of colours and SH: float32 or float16 (default: float32)")] = (
        "float32"
    )
    no_levels: Annotated[bool, switch("without levels of detail: exact pictures alone")] = False
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.store.build import build_store
        from fidsplat.store.store import Store

        memory, begun = bytes_of("--memory", self.memory), time.perf_counter()
        assert memory is not None
        with late_progress(console(True)) as progress:
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
        left = (f"left out: {count:,}: {why}" for why, count in store.header.dropped.items())
        rate = len(store) / seconds / 1e6
        return tell(self.json, facts, words + f"in {seconds:.1f} s ({rate:.2f} M/s): {folder}", *left)


@dataclass
class Place:
    """Place a store many times: the new store holds poses alone, and names the other by the way to it.

    Poses come from a file (camera to world, as for `fidsplat fly`), or stand on a grid, the first where the
    store itself is.

    Examples:
      fidsplat store place house.fss -o street.fss --grid 10,1,2 --pitch 12,0,30
      fidsplat store place house.fss -o town.fss --poses houses.tum
    """

    source: StorePath
    out: Out
    grid: Annotated[str | None, option("NX,NY,NZ", "places along the world's axes")] = None
    pitch: Annotated[str, option("DX,DY,DZ", "metres from place to place (default: 10,10,10)")] = "10,10,10"
    poses: Annotated[str | None, option("FILE", "poses, e.g. TUM, instead of a grid")] = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.formats import load_trajectory
        from fidsplat.store.instances import place_store
        from fidsplat.store.store import Store

        if (self.grid is None) == (self.poses is None):
            raise InputError("give --grid NX,NY,NZ or --poses FILE, and not both")
        if self.poses is not None:
            poses = list(load_trajectory(self.poses).poses)
        else:
            poses = _grid(_three("--grid", self.grid, int), _three("--pitch", self.pitch, float))
        store = Store(place_store(self.source, self.out, poses, overwrite=self.overwrite))
        facts = {"store": str(store.path), "places": store.places, "splats": len(store)}
        return tell(
            self.json,
            facts,
            f"{several(len(store), 'splats')} at {several(store.places, 'places')}: {store.path}",
        )


def _splats(store: fs.Store) -> str:
    return f"{several(len(store), 'splats')} in {several(store.chunks, 'chunks')}"


def _three(name: str, text: str | None, kind: type) -> list:
    try:
        values = [kind(word) for word in str(text).split(",")]
        if len(values) != 3 or (kind is int and min(values) < 1) or not all(abs(v) < 1e9 for v in values):
            raise ValueError
    except ValueError:
        what = "three whole numbers from 1 on" if kind is int else "three numbers of metres"
        raise InputError(f"{name} is {text!r}; give {what}, e.g. 10,1,2") from None
    return values


def _grid(counts: list[int], pitch: list[float]) -> list:
    import numpy as np

    if np.prod([float(count) for count in counts]) > 1e7:
        raise InputError(
            f"--grid asks for {' x '.join(map(str, counts))} places; at most 10,000,000 are made"
        )
    steps = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    poses = np.tile(np.eye(4), (len(steps), 1, 1))
    poses[:, :3, 3] = steps * pitch
    return list(poses)


@dataclass
class StoreInfo:
    """Say what a store holds: splats, chunks, levels of detail, bytes, bounds.

    Examples:
      fidsplat store info city.fss
      fidsplat store info city.fss --json
    """

    store: StorePath
    json: Json = False

    def run(self) -> int:
        return tell_store(self.store, self.json)


def tell_store(path: str, as_json: bool) -> int:
    """Print what a store holds; returns the exit status 0. Raises InputError for what is none."""
    from fidsplat.store.store import Store

    facts = _facts(Store(path))
    return tell(as_json, facts, table=(path, ("", ""), _rows(facts)))


def _facts(store: fs.Store) -> dict[str, Any]:
    import numpy as np

    nodes = store.nodes
    levels = [
        {
            "level": int(level),
            "nodes": int(np.count_nonzero(nodes["level"] == level)) * store.places,
            "splats": int(nodes["count"][nodes["level"] == level].sum()) * store.places,
            "cell_m": float(np.median(nodes["size"][nodes["level"] == level])),
        }
        for level in np.unique(nodes["level"])
    ]
    header = store.header
    facts = {"store": str(store.path), "splats": len(store), "kind": _KINDS[store.ellipsoids]}
    facts |= {"sh_degree": max(store.sh_degree, 0), "chunks": store.chunks, "places": store.places}
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
    """Measure what levels of detail cost: pictures with cells merged up to a size against the exact ones.

    From random places around and inside the store, at 320 x 180 pixels. What is found is kept beside the
    store, and lets Quality.detail_error choose, with the cut-off that it was measured with: fidsplat render
    city.fss --quality lowpass=pixel,alpha_cutoff=1e-8,detail_error=0.004
    The error holds on the measured views, with a margin of 3; other views may exceed it, fewer of them the
    more views are measured.

    Examples:
      fidsplat store measure city.fss
      fidsplat store measure city.fss --views 40 --lowpass pixel,screen
    """

    store: StorePath
    views: Annotated[int, option("N", "places to look from (default: 60)")] = 60
    lowpass: Annotated[str, option("A,B,...", "of pixel, screen, none (default: pixel)")] = "pixel"
    seed: Annotated[int, option("N", "of the places (default: 0)")] = 0
    device: Device = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.accuracy.detail_errors import measure_detail

        store, names = fs.Store(self.store), [name.strip() for name in self.lowpass.split(",")]
        with late_progress(console(True)) as progress:
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
    """Make a city of 20 million splats to fly through, with its levels of detail measured.

    DIR/city.fss is the store; DIR/city.toml a scene with a flight through a street and up over the roofs.
    Markers are ArUco markers of 0.8 m on the houses' walls, beside the store in the scene.

    Examples:
      fidsplat store demo -o city
      fidsplat store demo -o city --markers 1000
      fidsplat fly city/city.toml -o flight --rate 2
    """

    out: Annotated[str, option("DIR", "folder (default: fidsplat-city)", "-o")] = "fidsplat-city"
    splats: Annotated[float, option("N", "of the city (default: 20e6)")] = 20e6
    houses: Annotated[int, option("N", "along a side (default: 8)")] = 8
    seed: Annotated[int, option("N", "of houses and splats (default: 0)")] = 0
    markers: Annotated[int, option("N", "on the walls, 0 to 1,000 (default: 0)")] = 0
    views: Annotated[int, option("N", "places to measure from; 0: do not measure (default: 24)")] = 24
    device: Device = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.accuracy.detail_errors import measure_detail
        from fidsplat.accuracy.error import REFERENCE_CUTOFF
        from fidsplat.worlds.city import City, flight

        if not (math.isfinite(self.splats) and self.splats == int(self.splats)):
            raise InputError(f"--splats is {self.splats:g}; give a whole number")
        if not 0 <= self.views <= 10_000:
            raise InputError(f"--views is {self.views}; give 0 to 10,000")
        if not 0 <= self.markers <= 1000:
            raise InputError(f"--markers is {self.markers}; give 0 to 1,000")
        city, folder = City(int(self.splats), self.houses, self.seed), writable_folder(self.out)
        begun = time.perf_counter()
        with late_progress(console(True)) as progress:
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
        return tell(self.json, facts, words, f"fly through it: fidsplat fly {scene}")


DEMO_ERROR = 1 / 255
"""of the demo's pictures: below what eight bits show"""


@dataclass
class Verify:
    """Read all of a store and compare every chunk with its checksum; exit status 1 if one is damaged.

    Examples:
      fidsplat store verify city.fss
    """

    store: StorePath
    json: Json = False

    def run(self) -> int:
        from fidsplat.store.store import Store

        store = Store(self.store)
        with late_progress(console(True)) as progress:
            wrong = store.verify(progress)
        facts = {"store": self.store, "nodes": len(store.nodes), "damaged": wrong}
        tell(self.json, facts, *(wrong or [f"{self.store} is whole: {several(len(store.nodes), 'nodes')}"]))
        return 1 if wrong else 0


@dataclass
class Store:
    """Scenes on disk, larger than memory: build them, place them, look into them.

    Every command that takes a splat file takes a store (docs/large-scenes.md).

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
