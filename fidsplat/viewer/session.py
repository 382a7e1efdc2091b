"""A session: the scene that is shown and what draws it. Settings and scenes are exchanged in a thread: the
old ones draw until the kernels of the new ones are compiled."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from fidsplat.effects import FeatureSet, select
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer, default_device
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import Scene
from fidsplat.util.errors import FidsplatError
from fidsplat.viewer.settings import Settings, Viewpoint

_FIRST = Viewpoint((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0), 1.0, 64, 48)


@dataclass(frozen=True, eq=False)
class Drawn:
    """What pictures are drawn with."""

    scene: Scene
    settings: Settings
    device: str
    renderer: Renderer
    resident: ResidentCloud
    compiled: frozenset[FeatureSet]
    """what the renderer's kernels are compiled for"""
    version: int = 0


@dataclass(frozen=True, eq=False)
class View:
    """A picture, and what it is of."""

    frame: Frame
    drawn: Drawn
    viewpoint: Viewpoint

    def at(self, x: float, y: float) -> dict[str, object]:
        """What is seen at a place, 0 to 1 from the left and from the top: label, depth in metres, splat_id
        and, where it is of a marker, its spec. Depth is None where nothing is."""
        h, w = self.frame["label"].shape
        row, column = min(max(int(y * h), 0), h - 1), min(max(int(x * w), 0), w - 1)
        label, splat = (int(self.frame[name][row, column]) for name in ("label", "splat_id"))
        depth = float(self.frame["depth"][row, column])
        markers = {placed.label: placed.marker.spec for placed in self.drawn.scene.markers}
        found: dict[str, object] = {"label": label, "splat_id": splat, "depth": depth if depth > 0 else None}
        return found | {"marker": markers.get(label), "pixel": (column, row)}


@dataclass
class _Wish:
    scene: Scene | None = None
    settings: Settings | None = None
    done: list[Callable[[str | None], None]] = field(default_factory=list)


class Session:
    """What is shown to everybody who looks.

    Args:
        scene: at first.
        device: instead of the scene's.
        memory_budget: as `Renderer` takes it.
        changed: called, in whichever thread, when what is drawn has changed.

    Raises:
        DeviceError: the device cannot be used.
    """

    def __init__(
        self,
        scene: Scene,
        device: str | None = None,
        memory_budget: int | None = None,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self.changed, self._budget = changed, memory_budget
        self._wish, self._granting, self._wake = _Wish(), _Wish(), threading.Condition()
        self._working = self._closed = False
        self.drawn = self._made(scene, Settings.of(scene, device), None)
        self._thread = threading.Thread(target=self._work, name="viewer session", daemon=True)
        self._thread.start()

    def wish(
        self,
        scene: Scene | None = None,
        settings: Settings | None = None,
        done: Callable[[str | None], None] | None = None,
    ) -> None:
        """Draw another scene, or by other settings, as soon as its kernels are compiled. Only the newest wish
        of each kind is granted. done: called afterwards with None, or with what went wrong, in which case all
        stays as it is."""
        with self._wake:
            self._wish.scene = scene or self._wish.scene
            self._wish.settings = settings or self._wish.settings
            if done is not None:
                self._wish.done.append(done)
            self._wake.notify_all()

    def wanted(self) -> tuple[Scene, Settings]:
        """The scene and the settings that are drawn, or soon will be."""
        with self._wake:
            wish, drawn = self._wish, self.drawn
            return wish.scene or self._granting.scene or drawn.scene, (
                wish.settings or self._granting.settings or drawn.settings
            )

    def settle(self, timeout: float = 60.0) -> bool:
        """Wait until all wishes are granted; whether they are."""
        with self._wake:
            return self._wake.wait_for(lambda: not (self._working or self._wanted()), timeout)

    def draw(self, viewpoint: Viewpoint) -> View:
        """The picture from there that is looked at and asked."""
        drawn = self.drawn
        camera = viewpoint.camera(drawn.scene, drawn.settings.lens)
        frame = drawn.renderer.render(drawn.resident, drawn.settings.capture(drawn.scene, camera))
        return View(frame, drawn, viewpoint)

    def draw_moving(self, viewpoint: Viewpoint, scale: float) -> Frame:
        """The colours from there while one moves, that much smaller than the page, by coarser constants."""
        drawn = self.drawn
        camera = viewpoint.camera(drawn.scene, drawn.settings.lens, scale)
        return drawn.renderer.render(drawn.resident, drawn.settings.moving(drawn.scene, camera))

    def close(self) -> None:
        """Grant no more wishes."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        self._thread.join(timeout=10.0)

    def _wanted(self) -> bool:
        return self._wish.scene is not None or self._wish.settings is not None or bool(self._wish.done)

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or self._wanted())
                if self._closed:
                    return
                wish, self._wish = self._wish, _Wish()
                self._granting, self._working = wish, True
            problem = self._grant(wish)
            with self._wake:
                self._granting, self._working = _Wish(), False
                self._wake.notify_all()
            for done in wish.done:
                done(problem)

    def _grant(self, wish: _Wish) -> str | None:
        before = self.drawn
        try:
            self.drawn = self._made(wish.scene or before.scene, wish.settings or before.settings, before)
        except FidsplatError as error:
            return str(error)
        except MemoryError:
            return "not enough memory for this; all stays as it is"
        self.changed()
        return None

    def _made(self, scene: Scene, settings: Settings, before: Drawn | None) -> Drawn:
        """All that is needed to draw, compiled. What draws now is used where nothing new is to be compiled;
        else another renderer is opened, whose lock holds no picture up."""
        device = settings.device or default_device()
        camera = _FIRST.camera(scene, settings.lens)
        captures = settings.moving(scene, camera), settings.capture(scene, camera)
        features = frozenset(select(scene.splats, capture) for capture in captures)
        version = 0 if before is None else before.version + 1
        if before is not None and before.device == device and features <= before.compiled:
            same = scene.splats is before.scene.splats
            resident = before.resident if same else before.renderer.upload(scene)
            return replace(before, scene=scene, settings=settings, resident=resident, version=version)
        renderer = Renderer(device, self._budget)
        resident = renderer.upload(scene)
        for capture in captures:
            for name in (frame := renderer.render(resident, capture)).outputs:
                np.asarray(frame[name])
        return Drawn(scene, settings, device, renderer, resident, features, version)
