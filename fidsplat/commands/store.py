"""Command `fidsplat store`: build, place and check stores of splats on disk."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from fidsplat.commands.options import Device, Json, Overwrite, parse_numbers
from fidsplat.commands.output import console, delayed_progress, print_json, print_table, report
from fidsplat.experiments.city_demo import CityDemoSettings
from fidsplat.store.build_plan import BuildSettings
from fidsplat.store.detail_errors import DetailSettings
from fidsplat.util.errors import InputError, counted

if TYPE_CHECKING:
    import fidsplat as fs

Out = Annotated[str, "OUT.fss: store to write"]
StorePath = Annotated[tyro.conf.Positional[str], "STORE.fss: store to read"]


@dataclass
class Build:
    """Build a store of splat files of any size: spatially sorted chunks with levels of detail.

    PLY files are read in windows, so that --memory limits the memory; files of other formats are loaded
    completely. The same command resumes an interrupted build. Splats that cannot be rendered are dropped and
    counted. During the build the disk needs twice the size of the store.

    Examples:
      fidsplat store build street.ply -o street.fss
      fidsplat store build block-*.ply -o city.fss --memory 1GiB --sh-degree 1 --colors float16
    """

    inputs: tyro.conf.Positional[list[str]]
    """IN...: splat files"""
    out: Out
    settings: BuildSettings = field(default_factory=BuildSettings)
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs

        begun = time.perf_counter()
        with delayed_progress() as progress:
            store = fs.Store(
                fs.build_store(
                    self.inputs, self.out, self.settings, overwrite=self.overwrite, progress=progress
                )
            )
        seconds, facts = time.perf_counter() - begun, store.facts()
        facts = {name: facts[name] for name in ("store", "splats", "chunks", "bytes", "left_out")}
        words = f"{_splats(store)}, {store.nbytes / 2**20:.1f} MiB, in {seconds:.1f} s"
        rate = len(store) / seconds / 1e6
        dropped = (f"dropped: {count:,}: {why}" for why, count in store.header.dropped.items())
        return report(
            self.json, facts | {"seconds": seconds}, f"{words} ({rate:.2f} M/s): {store.path}", *dropped
        )


@dataclass
class Place:
    """Place instances of a store: the new store contains only poses and the path of the original.

    Poses come from a file (camera to world, as for `fidsplat fly`) or form a grid that starts at the pose of
    the original.

    Examples:
      fidsplat store place house.fss -o street.fss --grid 10,1,2 --pitch 12,0,30
      fidsplat store place house.fss -o town.fss --poses houses.tum
    """

    source: StorePath
    out: Out
    grid: str | None = None
    """NX,NY,NZ: instances along the world's axes"""
    pitch: str = "10,10,10"
    """DX,DY,DZ: metres between instances"""
    poses: str | None = None
    """FILE: poses, for example TUM, instead of a grid"""
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.store.instances import grid_poses

        if (self.grid is None) == (self.poses is None):
            raise InputError(
                "exactly one of --grid NX,NY,NZ and --poses FILE must be given, got "
                f"{'neither' if self.poses is None else 'both'}"
            )
        if self.poses is not None:
            poses = list(fs.load_trajectory(self.poses).poses)
        else:
            assert self.grid is not None
            counts = parse_numbers("--grid", self.grid, "3 whole numbers", 3)
            if any(n < 1 or n % 1 for n in counts):
                raise InputError(f"--grid must be whole numbers of at least 1, got {self.grid!r}")
            pitch = parse_numbers("--pitch", self.pitch, "3 lengths in metres", 3)
            poses = grid_poses([int(n) for n in counts], pitch)
        store = fs.Store(fs.place_store(self.source, self.out, poses, overwrite=self.overwrite))
        facts = {"store": str(store.path), "instances": store.instances, "splats": len(store)}
        words = f"{counted(len(store), 'splats')} at {counted(store.instances, 'instances')}: {store.path}"
        return report(self.json, facts, words)


def _splats(store: fs.Store) -> str:
    return f"{counted(len(store), 'splats')} in {counted(store.chunks, 'chunks')}"


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
    """Describe a store; returns the exit status 0. Raises InputError for another folder."""
    import fidsplat as fs

    facts = fs.Store(path).facts()
    return report(as_json, facts, table=(path, ("", ""), _rows(facts)))


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [("splats", f"{facts['splats']:,} ({facts['kind']}), SH degree {facts['sh_degree']}")]
    if facts["instanced_store"] is not None:
        rows.append(("instances", f"{facts['instances']:,} of {facts['instanced_store']}"))
    rows += [("chunks", f"{facts['chunks']:,}"), ("files", f"{facts['bytes'] / 2**20:.1f} MiB")]
    rows += [("made of", ", ".join(facts["sources"]))] if facts["sources"] else []
    rows += [("left out", f"{count:,}: {why}") for why, count in facts["left_out"].items()]
    rows += [
        (
            f"level {level['level']}",
            f"{counted(level['splats'], 'splats')} in {counted(level['nodes'], 'nodes')}, cells of "
            f"{level['cell_m']:.3g} m",
        )
        for level in facts["levels"]
        if level["level"]
    ]
    if facts["bounds"]:
        corners = ("(" + ", ".join(f"{value:.4g}" for value in corner) + ")" for corner in facts["bounds"])
        rows.append(("bounds", " to ".join(corners) + " m"))
    return rows


@dataclass
class Measure:
    """Measure the error of levels of detail against exact images.

    Renders random views around and inside the store at 320 x 180 pixels. The errors are saved in the store,
    so that Quality.detail_error can select levels, with the same cut-off: fidsplat render city.fss --quality
    lowpass=pixel,alpha_cutoff=1e-8,detail_error=0.004
    The error holds on the measured views with a margin of 3. Other views may exceed it, but fewer if more
    views are measured.

    Examples:
      fidsplat store measure city.fss
      fidsplat store measure city.fss --views 40 --lowpass pixel,screen
    """

    store: StorePath
    settings: DetailSettings = field(default_factory=DetailSettings)
    device: Device = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.accuracy.detail_errors import measure_detail

        with delayed_progress() as progress:
            measured = measure_detail(fs.Store(self.store), fs.Renderer(self.device), self.settings, progress)
        if self.json:
            print_json({"store": self.store, "details": [vars(detail) for detail in measured]})
            return 0
        for detail in measured:
            rows = (
                (f"{size:.3f}", "not measured" if error is None else f"{error:.4f}")
                for size, error in zip(detail.sizes, detail.errors, strict=True)
            )
            title = f"lowpass {detail.lowpass}, level {detail.level}, {detail.views} views, {detail.device}"
            print_table(console(False), title, ("cells up to [px]", "largest error of rgb"), rows)
        return 0


@dataclass
class StoreDemo:
    """Make a city of 20 million splats with measured levels of detail.

    DIR/city.fss is the store, DIR/city.toml a scene with a flight through a street and over the roofs.
    --markers places ArUco markers of 0.8 m on the walls of houses in the scene; the store has no markers.

    Examples:
      fidsplat store demo -o city
      fidsplat store demo -o city --markers 1000
      fidsplat fly city/city.toml -o flight --rate 2
    """

    out: str = "fidsplat-city"
    """DIR: folder"""
    city: CityDemoSettings = field(default_factory=CityDemoSettings)
    device: Device = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.city_demo import write_city

        begun = time.perf_counter()
        with delayed_progress() as progress:
            store, scene = write_city(self.out, self.city, self.device, self.overwrite, progress)
        seconds = time.perf_counter() - begun
        facts = {"store": str(store.path), "scene": str(scene), "splats": len(store), "seconds": seconds}
        words = f"{_splats(store)}, in {seconds:.0f} s: {store.path}"
        return report(self.json, facts, words, f"fly through it: fidsplat fly {scene}")


@dataclass
class Verify:
    """Compare every chunk of a store with its checksum; the exit status is 1 if a chunk is damaged.

    Examples:
      fidsplat store verify city.fss
    """

    store: StorePath
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs

        store = fs.Store(self.store)
        with delayed_progress() as progress:
            wrong = store.verify(progress)
        facts = {"store": self.store, "nodes": len(store.nodes), "damaged": wrong}
        report(
            self.json, facts, *(wrong or [f"{self.store} is complete: {counted(len(store.nodes), 'nodes')}"])
        )
        return 1 if wrong else 0


@dataclass
class Store:
    """Build stores (scenes on disk that may be larger than memory), place instances of them, describe them.

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
