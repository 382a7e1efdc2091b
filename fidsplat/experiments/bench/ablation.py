"""Ablation of effects: the same frames without one effect at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fidsplat.cameras import Camera, Motion, Orthographic, Shutter
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.effects import select
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud


@dataclass(frozen=True)
class ReducedScene:
    """A frame without an effect."""

    capture: Capture
    scene: Scene | None = None
    """scene with the remaining splats; None: all splats"""

    def cloud(self) -> SplatCloud | None:
        """Splats to render; None: all splats of the original scene."""
        return None if self.scene is None else self.scene.cloud()


def without_effects(scene: Scene, capture: Capture) -> dict[str, ReducedScene]:
    """Frames that each lack one effect of a capture, by the name of the effect.

    An effect is included if its removal changes the selected kernels; `markers` are if the scene has other
    splats.
    """
    cloud, quality, standard = scene.cloud(), capture.quality, Quality()
    reduced = {
        "lens": replace(capture, camera=_without_lens(capture.camera)),
        "shutter": replace(capture, shutter=Shutter(time=capture.shutter.time)),
        "moving groups": replace(capture, motion=Motion(capture.motion.camera)),
        "order": replace(capture, quality=quality.with_(order="centre")),
        "samples": replace(capture, quality=quality.with_(samples=1)),
        "low-pass": replace(capture, quality=quality.with_(lowpass=standard.lowpass)),
        "outputs": replace(capture, outputs=("rgb",)),
        "sensor": replace(capture, sensor=Sensor()),
        "fog": replace(capture, fog=None),
        "background": replace(capture, background=(0.0, 0.0, 0.0)),
    }
    features = select(cloud, capture)
    variants = {name: ReducedScene(less) for name, less in reduced.items() if select(cloud, less) != features}
    if scene.markers and (scene.clouds or scene.stores):
        rest = replace(scene, markers=())
        motion = Motion(capture.motion.camera, rest.motion.groups)
        variants["markers"] = ReducedScene(replace(capture, motion=motion), rest)
    return variants


def middle_camera(capture: Capture) -> Camera:
    """The camera at the pose of the shutter's time."""
    assert capture.camera is not None
    return capture.motion.moved(capture.camera, capture.shutter.time)


def _without_lens(camera: Camera | None) -> Camera | None:
    """The camera without its lens: a pinhole with the same focal lengths, or 53 degrees wide for an
    orthographic camera."""
    if camera is None or not isinstance(camera.lens, Orthographic):
        return camera and replace(camera, lens=None)
    return replace(camera, lens=None, fx=float(camera.width), fy=float(camera.width))
