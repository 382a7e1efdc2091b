"""The page's panel: sliders and selectors for how it is drawn, and buttons for what is done with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

from fidsplat.capture.quality import PRESETS
from fidsplat.scenes import Scene
from fidsplat.util.markdown import escaped
from fidsplat.viewer.session import Session
from fidsplat.viewer.settings import LENSES, Settings

NOBODY = "none"
OF_SCENE = "the scene's"


class Actions(Protocol):
    """What the buttons do; client is viser's handle of who pressed."""

    def picture(self, client: Any) -> None: ...
    def read(self, client: Any) -> None: ...
    def add_keyframe(self, client: Any) -> None: ...
    def save_keyframes(self, client: Any) -> None: ...
    def clear_keyframes(self, client: Any) -> None: ...
    def movable(self, scene: Scene) -> list[str]: ...
    def hold(self, name: str) -> None: ...
    def overlay(self, visible: bool) -> None: ...


class Controls:
    """The panel of a viser page (its `gui`).

    Args:
        devices: names to choose from; the session's own is among them.
    """

    def __init__(self, gui: Any, session: Session, devices: list[str], actions: Actions) -> None:
        self._gui, self._session = gui, session
        self._sliders: dict[str, Any] = {}
        drawn = session.drawn
        self._drawing = gui.add_folder("Drawing")
        with self._drawing:
            self.status = gui.add_markdown("")
            self._choice("device", devices, drawn.device, lambda value: {"device": value})
            self._choice(
                "quality", [OF_SCENE, *PRESETS], OF_SCENE, lambda v: {"quality": None if v == OF_SCENE else v}
            )
            self._lens = self._choice(
                "lens", _lenses(drawn.scene), drawn.settings.lens, lambda value: {"lens": value}
            )
            self._slider("fog", "fog [1/m]", 0.0, 2.0, 0.01)
            self._slider("exposure", "exposure", 0.0, 4.0, 0.05)
            self._slider("noise", "shot noise", 0.0, 0.3, 0.005)
        self._offer_times(drawn.scene)
        with gui.add_folder("Scene"):
            names = [NOBODY, *actions.movable(drawn.scene)]
            self._held = held = gui.add_dropdown("move", names, initial_value=NOBODY)
            held.on_update(lambda _: actions.hold(held.value))
            shown = gui.add_checkbox("outlines", True)
            shown.on_update(lambda _: actions.overlay(shown.value))
            self._button("What a detector sees", actions.read)
            self._button("Picture", actions.picture)
        with gui.add_folder("Trajectory"):
            self._button("Add keyframe", actions.add_keyframe)
            self._button("Save keyframes", actions.save_keyframes)
            self._button("Clear keyframes", actions.clear_keyframes)
        self.say("")

    def say(self, problem: str) -> None:
        """How it is drawn now, and what went wrong, if anything did."""
        drawn = self._session.drawn
        lines = [f"{len(drawn.resident):,} splats, {escaped(drawn.renderer.device.title)}"]
        self.status.content = "\n\n".join(lines + ([f"**{escaped(problem)}**"] if problem else []))

    def offer(self, names: list[str]) -> None:
        """Let what another scene has be moved; none of it is held at first."""
        self._held.value = NOBODY
        self._held.options = [NOBODY, *names]

    def follow(self, scene: Scene, settings: Settings) -> None:
        """Stand where settings are that came with another scene, not from here."""
        self._offer_times(scene)
        for name, slider in self._sliders.items():
            value = float(getattr(settings, name))
            slider.min, slider.max = min(slider.min, value), max(slider.max, value)
            slider.value = value
        if self._lens.value != settings.lens or self._lens.options != tuple(_lenses(scene)):
            self._lens.options = list(dict.fromkeys([*_lenses(scene), settings.lens]))
            self._lens.value = settings.lens

    def _offer_times(self, scene: Scene) -> None:
        """Have sliders of the clock where something moves, and none elsewhere."""
        if not scene.motion.groups:
            for name in {"time", "exposure_ms", "readout_ms"} & self._sliders.keys():
                self._sliders.pop(name).remove()
        elif "time" in self._sliders:
            self._sliders["time"].min, self._sliders["time"].max = _span(scene)
        else:
            with self._drawing:
                self._slider("time", "time [s]", *_span(scene), 0.01)
                self._slider("exposure_ms", "exposure time [ms]", 0.0, 200.0, 1.0)
                self._slider("readout_ms", "readout [ms]", 0.0, 100.0, 1.0)

    def _change(self, **changes: Any) -> None:
        _, settings = self._session.wanted()
        changed = replace(settings, **changes)
        if changed != settings:
            self._session.wish(settings=changed, done=lambda why: self.say(why or ""))

    def _choice(self, label: str, options: list[str], value: str, of: Callable[[str], dict[str, Any]]) -> Any:
        handle = self._gui.add_dropdown(label, options, initial_value=value)
        handle.on_update(lambda _: self._change(**of(handle.value)))
        return handle

    def _slider(self, name: str, label: str, low: float, high: float, step: float) -> None:
        value = float(getattr(self._session.drawn.settings, name))
        handle = self._gui.add_slider(label, min(low, value), max(high, value), step, value)
        handle.on_update(lambda _: self._change(**{name: float(handle.value)}))
        self._sliders[name] = handle

    def _button(self, label: str, act: Callable[[Any], None]) -> None:
        self._gui.add_button(label).on_click(lambda event: act(event.client))


def _lenses(scene: Scene) -> list[str]:
    own = scene.camera is not None and scene.camera.lens is not None
    return [lens for lens in LENSES if lens != "scene" or own]


def _span(scene: Scene) -> tuple[float, float]:
    """The times between which keyframes of the scene lie; 0 to 1 where motions are functions."""
    motions = [*scene.cloud_motions.values(), *(p.motion for p in scene.markers if p.motion is not None)]
    times = [float(time) for motion in motions for time in getattr(motion, "times", ())]
    return (min(times), max(times)) if len(set(times)) > 1 else (0.0, 1.0)
