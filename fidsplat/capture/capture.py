"""Capture: a render request, with all settings of a frame except the splats."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypedDict

from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.capture.environment import Background, ExternalDepth, Fog, background_of
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.util.arguments import PickledByFields
from fidsplat.util.errors import InputError, unknown

_CLASSES = {
    **{"motion": Motion, "shutter": Shutter, "sensor": Sensor, "fog": Fog},
    **{"external_depth": ExternalDepth},
}
# shared by captures: constructing them takes longer than the rest of a capture
_QUALITY, _MOTION, _SHUTTER, _SENSOR = Quality(), Motion(), Shutter(), Sensor()
_DEFAULTS = {"motion": _MOTION, "shutter": _SHUTTER, "sensor": _SENSOR}


@dataclass(frozen=True, eq=False)
class Capture(PickledByFields):
    """Render request: camera, outputs, quality, background, motion, shutter, sensor and fog of a frame.

    Raises InputError for a value of the wrong type; output names are validated when the frame is rendered.
    """

    camera: Camera | None = None
    """None: must be set before rendering"""
    outputs: tuple[str, ...] = ("rgb",)
    """names of the output images; a single name may be a str"""
    quality: Quality = _QUALITY
    """a Quality, or text as of `Quality.of`, such as "fast" or "fast,samples=2"; None: standard"""
    background: Background = (0.0, 0.0, 0.0)
    """behind the splats: RGB in display space, a Gradient or a Panorama"""
    motion: Motion = _MOTION
    """motion of the camera and of groups of splats; None is replaced by an empty Motion"""
    shutter: Shutter = _SHUTTER
    """time, exposure and readout; None: an instant at time 0"""
    sensor: Sensor = _SENSOR
    """sensor applied to rgb; None: no sensor"""
    fog: Fog | None = None
    """fog between the camera and the splats"""
    external_depth: ExternalDepth | None = None
    """external depth image of the camera's size from another renderer: an opaque surface among the splats"""

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        if self.camera is not None and not isinstance(self.camera, Camera):
            raise InputError(f"camera must be a Camera, e.g. fs.Camera.look_at(...), got {self.camera!r}")
        set_field(self, "outputs", output_names(self.outputs))
        set_field(self, "quality", Quality.of(self.quality))
        set_field(self, "background", background_of(self.background))
        for name, kind in _CLASSES.items():
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InputError(f"{name} must be a {kind.__name__}, got {value!r}")
            if value is None and name in _DEFAULTS:
                set_field(self, name, _DEFAULTS[name])

    @cached_property
    def has_fog(self) -> bool:
        """Whether there is fog with a density above 0."""
        return self.fog is not None and self.fog.density > 0

    @cached_property
    def rendered_background(self) -> Background:
        """The fog's colour, or the background if there is no fog."""
        return self.fog.color if self.fog is not None and self.has_fog else self.background

    @cached_property
    def has_sub_frames(self) -> bool:
        """Whether the frame has several sub-frames."""
        if self.motion.is_still:
            return False
        rows = self.shutter.rows_per_band + 1 if self.camera is None else self.camera.height
        return len(self.shutter.bands(rows)) > 1 or len(self.shutter.times(0.0)) > 1

    def picklable(self) -> Capture:
        """A copy that can be pickled: poses at the shutter's times replace motion functions."""
        if self.motion.is_still or self.camera is None:
            return self
        shutter = self.shutter
        middles = [middle for _, _, middle in shutter.bands(self.camera.height)]
        times = [shutter.time, *(time for middle in middles for time in shutter.times(middle))]
        return replace(self, motion=self.motion.sampled(times))

    def with_(self, **changes: Any) -> Capture:
        """A copy with some fields changed; None leaves a field unchanged. Raises InputError for an unknown
        field or a value of the wrong type."""
        for name in changes:
            if name not in self.__dataclass_fields__:
                raise InputError(unknown("field of a capture", name, self.__dataclass_fields__))
        changes = {name: value for name, value in changes.items() if value is not None}
        return replace(self, **changes) if changes else self


class CaptureFields(TypedDict, total=False):
    """Keyword arguments that replace fields of a capture; None leaves a field unchanged."""

    camera: Camera | None
    background: Background | Iterable[float] | None
    motion: Motion | None
    shutter: Shutter | None
    sensor: Sensor | None
    fog: Fog | None
    external_depth: ExternalDepth | None


def output_names(outputs: Any) -> tuple[str, ...]:
    """Distinct names of outputs, from one name or several. Raises InputError for other types or no name."""
    try:
        names: tuple[Any, ...] = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    except TypeError:  # a 0-dimensional array is an Iterable too
        names = (outputs,)
    if not names:
        raise InputError("outputs must have at least one name, e.g. 'rgb', got none")
    for name in names:
        if not isinstance(name, str):
            raise InputError(f"outputs must be one or more names, got {outputs!r}")
    return tuple(dict.fromkeys(names))
