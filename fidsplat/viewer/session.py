"""Viewer session: scene, settings and renderer. A thread compiles the kernels of a new state while the old
one is still rendered."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from fidsplat.cameras import Shutter
from fidsplat.effects import FeatureSet, select
from fidsplat.markers import Marker
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer, default_device
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.util.errors import FidsplatError
from fidsplat.viewer.settings import Settings, Viewpoint

_FIRST = Viewpoint((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0), 1.0, 64, 48)


@dataclass(frozen=True, eq=False)
class RenderState:
    """Scene and settings with a renderer, compiled kernels and uploaded splats."""

    scene: Scene
    settings: Settings
    device: str
    renderer: Renderer
    resident: ResidentCloud
    compiled: frozenset[FeatureSet]
    """feature sets whose kernels are compiled"""
    version: int = 0


@dataclass(frozen=True, eq=False)
class StillImage:
    """An exact image with its scene and viewpoint."""

    frame: Frame
    state: RenderState
    viewpoint: Viewpoint

    def occluding_depth(self) -> np.ndarray:
        """Depth (h, w) in metres that occludes outlines: the median depth, infinite where nothing is opaque.

        The largest depth of 3 x 3 pixels, increased by 0.5 %, so that outlines on a surface are visible.
        """
        depth = self.frame["depth_median"]
        depth = np.pad(np.where(depth > 0, depth, np.inf), 1, constant_values=-np.inf)
        return 1.005 * np.lib.stride_tricks.sliding_window_view(depth, (3, 3)).max((2, 3))

    def pick(self, x: float, y: float) -> dict[str, object]:
        """Label, depth in metres (None for the background), splat_id and marker spec of a pixel.

        Args:
            x, y: position in the image, 0 to 1 from the left and from the top.
        """
        h, w = self.frame["label"].shape
        row, column = min(max(int(y * h), 0), h - 1), min(max(int(x * w), 0), w - 1)
        label, splat = (int(self.frame[name][row, column]) for name in ("label", "splat_id"))
        depth = float(self.frame["depth"][row, column])
        markers = {placed.label: placed.marker.spec for placed in self.state.scene.markers}
        picked: dict[str, object] = {"label": label, "splat_id": splat, "depth": depth if depth > 0 else None}
        return picked | {"marker": markers.get(label), "pixel": (column, row)}

    def place(self, marker: Marker, x: float, y: float) -> PlacedMarker:
        """The marker on the surface at a position in the image, 0 to 1 from the left and from the top.

        Raises InputError if less than half of the marker's area is one plane.
        """
        state, camera = self.state, self.frame.capture.camera
        assert camera is not None
        scene = replace(state.scene, shutter=Shutter(time=state.settings.time))
        pixel = (min(max(x, 0.0), 1.0) * camera.width, min(max(y, 0.0), 1.0) * camera.height)
        options = {"renderer": state.renderer, "resident": state.resident}
        return scene.place(marker, camera=camera, pixel=pixel, **options).markers[-1]


@dataclass
class _Request:
    scene: Scene | None = None
    settings: Settings | None = None
    done: list[Callable[[str | None], None]] = field(default_factory=list)


class Session:
    """The render state that all browsers share.

    Args:
        scene: initial scene.
        device: device that replaces the scene's.
        memory_budget: bytes of device memory, see `Renderer`.
        changed: called after the state has changed, in any thread.

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
        self._pending, self._applying, self._wake = _Request(), _Request(), threading.Condition()
        self._working = self._closed = False
        self.state = self._prepare(scene, Settings.of(scene, device), None)
        self._thread = threading.Thread(target=self._work, name="viewer session", daemon=True)
        self._thread.start()

    def request(
        self,
        scene: Scene | None = None,
        settings: Settings | None = None,
        done: Callable[[str | None], None] | None = None,
    ) -> None:
        """Change to another scene or other settings when their kernels are compiled; replaces pending
        requests.

        done: called afterwards with None, or with an error message if the old state remains.
        """
        with self._wake:
            self._pending.scene = scene or self._pending.scene
            self._pending.settings = settings or self._pending.settings
            if done is not None:
                self._pending.done.append(done)
            self._wake.notify_all()

    def requested(self) -> tuple[Scene, Settings]:
        """The scene and settings of the newest request, or else the current ones."""
        with self._wake:
            request, state = self._pending, self.state
            return request.scene or self._applying.scene or state.scene, (
                request.settings or self._applying.settings or state.settings
            )

    def settle(self, timeout: float = 60.0) -> bool:
        """Wait until no request is pending; return False after the timeout [s]."""
        with self._wake:
            return self._wake.wait_for(lambda: not (self._working or self._has_pending()), timeout)

    def render(self, viewpoint: Viewpoint) -> StillImage:
        """The exact image of a viewpoint."""
        state = self.state
        camera = viewpoint.camera(state.scene, state.settings.lens)
        frame = state.renderer.render(state.resident, state.settings.capture(state.scene, camera))
        return StillImage(frame, state, viewpoint)

    def render_moving(self, viewpoint: Viewpoint, scale: float) -> Frame:
        """The image of a viewpoint while the camera moves: rgb at a coarser quality, smaller by `scale`."""
        state = self.state
        camera = viewpoint.camera(state.scene, state.settings.lens, scale)
        return state.renderer.render(state.resident, state.settings.moving(state.scene, camera))

    def close(self) -> None:
        """Stop applying requests."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        self._thread.join(timeout=10.0)

    def _has_pending(self) -> bool:
        return (
            self._pending.scene is not None or self._pending.settings is not None or bool(self._pending.done)
        )

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or self._has_pending())
                if self._closed:
                    return
                request, self._pending = self._pending, _Request()
                self._applying, self._working = request, True
            problem = self._apply(request)
            with self._wake:
                self._applying, self._working = _Request(), False
                self._wake.notify_all()
            for done in request.done:
                done(problem)

    def _apply(self, request: _Request) -> str | None:
        before = self.state
        try:
            self.state = self._prepare(
                request.scene or before.scene, request.settings or before.settings, before
            )
        except FidsplatError as error:
            return str(error)
        except MemoryError:
            return "not enough memory for this change; the previous state remains"
        self.changed()
        return None

    def _prepare(self, scene: Scene, settings: Settings, before: RenderState | None) -> RenderState:
        """A render state with compiled kernels. If kernels must be compiled, a new renderer compiles them, as
        the lock of the current one would delay images."""
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
        return RenderState(scene, settings, device, renderer, resident, features, version)
