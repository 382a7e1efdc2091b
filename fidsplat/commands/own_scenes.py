"""One's own scenes in the commands that measure: --scene FILE --cameras FILE."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import console, late_progress, option
from fidsplat.commands.render import load_source
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.experiments.bench.catalogue import BenchScene

OwnScenes = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    option("SCENE.toml|FILE.ply", "one's own, instead of --scenes; once more for each"),
]
Cameras = Annotated[str | None, option("FILE", "poses, camera to world, for --scene (docs/trajectories.md)")]


def own_scenes_of(
    files: tuple[str, ...], cameras: str | None, named: tuple[str, ...]
) -> dict[str, BenchScene]:
    """The scenes of --scene, from the poses of --cameras; none where there is no --scene.

    Raises:
        InputError: --scenes beside them, --cameras alone, or a file that cannot be read.
    """
    from fidsplat.experiments.bench.catalogue import own_scenes
    from fidsplat.formats import load_trajectory

    if files and named:
        raise InputError("--scene and --scenes exclude each other; give one of them")
    if cameras is not None and not files:
        raise InputError("--cameras are those of --scene; give that as well")
    path = None if cameras is None else load_trajectory(cameras)
    found: dict[str, BenchScene] = {}
    for name in files:
        with late_progress(console(True)) as progress:
            found |= own_scenes(name, load_source(name, None, progress), path)
    return found
