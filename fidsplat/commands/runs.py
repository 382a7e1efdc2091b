"""What `fidsplat view` shows of a run: a flight's folder, or a training that goes on while one looks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, read_text

if TYPE_CHECKING:
    from fidsplat.scenes import Scene

CHECKPOINT = ".training.npz"
"""how a checkpoint's name ends"""


def checkpoint_of(source: Path) -> Path | None:
    """The checkpoint of a training run's folder, or the source if it is one; None where it is neither.

    Raises:
        InputError: the folder holds those of several runs.
    """
    if source.name.endswith(CHECKPOINT):
        return source
    found = sorted(source.glob(f"*{CHECKPOINT}")) if source.is_dir() else []
    if len(found) > 1:
        names = ", ".join(file.name for file in found)
        raise InputError(f"{source} holds several training runs; name one of {names} there")
    return found[0] if found else None


def flown(folder: Path) -> tuple[str, str]:
    """Of a flight's folder what was drawn, and the file of its poses.

    Raises:
        InputError: it is no folder of `fidsplat fly`, or what was drawn is not there any more.
    """
    from fidsplat.render.flight import POSES, RECORD

    poses = folder / POSES
    try:
        source = from_json(read_text(folder / RECORD))["source"]
        file = folder / source
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            f"{folder} is the folder of no run: it holds neither *{CHECKPOINT}, of `fidsplat train`, nor a "
            f"{RECORD}, of `fidsplat fly`, that says what was drawn; "
            "to see a scene, give its file"
        ) from None
    if not file.exists():
        raise InputError(
            f"{folder} is a flight through {source}, which is not there any more; give what it was moved to, "
            f"with --trajectory {poses}"
        )
    return str(file), str(poses)


class TrainingRun:
    """The splats of a training run, by its checkpoint, which grows while the run goes on."""

    def __init__(self, file: Path, quality: str | None = None) -> None:
        self.file, self._quality = file, quality
        self._seen = self._stamp()
        self.scene = self._load()

    def again(self) -> Scene | None:
        """The splats as they are now, if the run has written others since this was last asked; from the
        camera that the first were seen by."""
        stamp = self._stamp()
        if stamp is None or stamp == self._seen:
            return None
        self._seen = stamp
        self.scene = replace(self._load(), camera=self.scene.camera)
        return self.scene

    def _load(self) -> Scene:
        from fidsplat.commands.framing import framing_camera
        from fidsplat.scenes import Scene
        from fidsplat.train import splats_of

        cloud, background = splats_of(self.file)
        return Scene((cloud,), camera=framing_camera(cloud), background=background, quality=self._quality)

    def _stamp(self) -> tuple[int, int] | None:
        try:
            found = self.file.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size
