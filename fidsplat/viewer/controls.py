"""Control panel of the page: sliders, selectors and buttons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

from fidsplat.capture.quality import PRESETS
from fidsplat.scenes import Scene
from fidsplat.util.markup import escaped
from fidsplat.viewer.session import Session
from fidsplat.viewer.settings import LENSES, Settings

NO_TARGET = "none"
SCENE_QUALITY = "the scene's"


class Actions(Protocol):
    """Actions of the buttons; client is viser's handle of the browser."""

    def save_image(self, client: Any) -> None: ...
    def detect_markers(self, client: Any) -> None: ...
    def add_keyframe(self, client: Any) -> None: ...
    def save_keyframes(self, client: Any) -> None: ...
    def clear_keyframes(self, client: Any) -> None: ...
    def target_names(self, scene: Scene) -> list[str]: ...
    def select_target(self, name: str) -> None: ...
    def overlay(self, visible: bool) -> None: ...


class Controls:
    """The panel of a viser page (its `gui`).

    Args:
        devices: names in the device menu, including the session's device.
    """

    def __init__(self, gui: Any, session: Session, devices: list[str], actions: Actions) -> None:
        self._gui, self._session = gui, session
        self._sliders: dict[str, Any] = {}
        state = session.state
        self._rendering = gui.add_folder("Rendering")
        with self._rendering:
            self.status = gui.add_markdown("")
            self._choice("device", devices, state.device, lambda value: {"device": value})
            self._choice(
                "quality",
                [SCENE_QUALITY, *PRESETS],
                SCENE_QUALITY,
                lambda v: {"quality": None if v == SCENE_QUALITY else v},
            )
            self._lens = self._choice(
                "lens", _lenses(state.scene), state.settings.lens, lambda value: {"lens": value}
            )
            self._slider("fog", "fog [1/m]", 0.0, 2.0, 0.01)
            self._slider("exposure", "exposure", 0.0, 4.0, 0.05)
            self._slider("noise", "shot noise", 0.0, 0.3, 0.005)
        self._offer_times(state.scene)
        with gui.add_folder("Scene"):
            names = [NO_TARGET, *actions.target_names(state.scene)]
            self._targets = targets = gui.add_dropdown("move", names, initial_value=NO_TARGET)
            targets.on_update(lambda _: actions.select_target(targets.value))
            shown = gui.add_checkbox("outlines", True)
            shown.on_update(lambda _: actions.overlay(shown.value))
            self._button("Detect markers", actions.detect_markers)
            self._button("Save image", actions.save_image)
        with gui.add_folder("New marker"):
            self._places = gui.add_checkbox("place by a click", False)
            self._spec = gui.add_text("spec", "apriltag:36h11:0")
            self._size = gui.add_number("size [m]", 0.16, min=1e-4, step=1e-4)
        with gui.add_folder("Trajectory"):
            self._button("Add keyframe", actions.add_keyframe)
            self._button("Save keyframes", actions.save_keyframes)
            self._button("Clear keyframes", actions.clear_keyframes)
        self.show_status("")

    def show_status(self, problem: str) -> None:
        """Show the number of splats, the device and an error message, which may be empty."""
        state = self._session.state
        lines = [f"{len(state.resident):,} splats, {escaped(state.renderer.device.title)}"]
        self.status.content = "\n\n".join(lines + ([f"**{escaped(problem)}**"] if problem else []))

    @property
    def new_marker(self) -> tuple[str, float] | None:
        """Spec and size [m] of the marker that a click places; None: a click reads the pixel."""
        return (self._spec.value, float(self._size.value)) if self._places.value else None

    def end_placing(self) -> None:
        """Let the next click read the pixel."""
        self._places.value = False

    def offer_targets(self, names: list[str]) -> None:
        """Replace the names in the selector of the gizmo, and select none."""
        self._targets.value = NO_TARGET
        self._targets.options = [NO_TARGET, *names]

    def update_from(self, scene: Scene, settings: Settings) -> None:
        """Set the sliders and selectors to other settings."""
        self._offer_times(scene)
        for name, slider in self._sliders.items():
            value = float(getattr(settings, name))
            slider.min, slider.max = min(slider.min, value), max(slider.max, value)
            slider.value = value
        if self._lens.value != settings.lens or self._lens.options != tuple(_lenses(scene)):
            self._lens.options = list(dict.fromkeys([*_lenses(scene), settings.lens]))
            self._lens.value = settings.lens

    def _offer_times(self, scene: Scene) -> None:
        """Show the sliders of the shutter if and only if the scene moves."""
        if not scene.motion.groups:
            for name in {"time", "exposure_ms", "readout_ms"} & self._sliders.keys():
                self._sliders.pop(name).remove()
        elif "time" in self._sliders:
            self._sliders["time"].min, self._sliders["time"].max = _span(scene)
        else:
            with self._rendering:
                self._slider("time", "time [s]", *_span(scene), 0.01)
                self._slider("exposure_ms", "exposure time [ms]", 0.0, 200.0, 1.0)
                self._slider("readout_ms", "readout [ms]", 0.0, 100.0, 1.0)

    def _change(self, **changes: Any) -> None:
        _, settings = self._session.requested()
        changed = replace(settings, **changes)
        if changed != settings:
            self._session.request(settings=changed, done=lambda why: self.show_status(why or ""))

    def _choice(self, label: str, options: list[str], value: str, of: Callable[[str], dict[str, Any]]) -> Any:
        handle = self._gui.add_dropdown(label, options, initial_value=value)
        handle.on_update(lambda _: self._change(**of(handle.value)))
        return handle

    def _slider(self, name: str, label: str, low: float, high: float, step: float) -> None:
        value = float(getattr(self._session.state.settings, name))
        handle = self._gui.add_slider(label, min(low, value), max(high, value), step, value)
        handle.on_update(lambda _: self._change(**{name: float(handle.value)}))
        self._sliders[name] = handle

    def _button(self, label: str, act: Callable[[Any], None]) -> None:
        self._gui.add_button(label).on_click(lambda event: act(event.client))


def _lenses(scene: Scene) -> list[str]:
    has_lens = scene.camera is not None and scene.camera.lens is not None
    return [lens for lens in LENSES if lens != "scene" or has_lens]


def _span(scene: Scene) -> tuple[float, float]:
    """Time range of the scene's keyframes; 0 to 1 for motions that are functions."""
    motions = [*scene.cloud_motions.values(), *(p.motion for p in scene.markers if p.motion is not None)]
    times = [float(time) for motion in motions for time in getattr(motion, "times", ())]
    return (min(times), max(times)) if len(set(times)) > 1 else (0.0, 1.0)
