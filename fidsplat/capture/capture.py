"""Capture: everything that a picture is but the splats; plain data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, TypedDict

from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.capture.environment import Background, ExternalDepth, Fog, background_of
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.util.arguments import PickledByFields
from fidsplat.util.errors import InputError, unknown


@dataclass(frozen=True, eq=False)
class Capture(PickledByFields):
    """How a picture is taken: from where, of what, and how well.

    The same object works on every device. Raises InputError for a value of the wrong kind; whether an output
    exists is checked when it is drawn.
    """

    camera: Camera | None = None
    """None: still to be said; no picture is drawn without one"""
    outputs: tuple[str, ...] = ("rgb",)
    """names of the output images; one may be given as it is"""
    quality: Quality = field(default_factory=Quality)
    """a Quality, or text such as "fast" or "fast,samples=2" (`Quality.of`); None: standard"""
    background: Background = (0.0, 0.0, 0.0)
    """behind the splats: RGB in display space, a Gradient or a Panorama"""
    motion: Motion = field(default_factory=Motion)
    """how the camera and groups of splats move; None: they stand still"""
    shutter: Shutter = field(default_factory=Shutter)
    """when the picture is taken, and how long that takes; None: at time 0, at once"""
    sensor: Sensor = field(default_factory=Sensor)
    """what becomes of rgb on its way out; None: nothing"""
    fog: Fog | None = None
    """between the camera and what it sees"""
    external_depth: ExternalDepth | None = None
    """image with depths of another renderer, an opaque surface among the splats; of the camera's size"""

    def __post_init__(self) -> None:
        put = object.__setattr__
        if self.camera is not None and not isinstance(self.camera, Camera):
            raise InputError(f"camera is {self.camera!r}; it must be a Camera, e.g. fs.Camera.look_at(...)")
        put(self, "outputs", output_names(self.outputs))
        put(self, "quality", Quality.of(self.quality))
        put(self, "background", background_of(self.background))
        for name, kind in (("motion", Motion), ("shutter", Shutter), ("sensor", Sensor)):
            put(self, name, _of_kind(name, getattr(self, name), kind) or kind())
        _of_kind("fog", self.fog, Fog)
        _of_kind("external_depth", self.external_depth, ExternalDepth)

    @cached_property
    def foggy(self) -> bool:
        """Whether there is fog to be seen."""
        return self.fog is not None and self.fog.density > 0

    @cached_property
    def backdrop(self) -> Background:
        """What is seen behind everything: fog, of which there is enough there to hide any background, or else
        the background."""
        return self.fog.color if self.fog is not None and self.foggy else self.background

    @cached_property
    def exposed(self) -> bool:
        """Whether the picture is made of several poses."""
        if self.motion.is_still:
            return False
        rows = self.shutter.rows_per_band + 1 if self.camera is None else self.camera.height
        return len(self.shutter.bands(rows)) > 1 or len(self.shutter.times(0.0)) > 1

    def picklable(self) -> Capture:
        """The same capture, with poses at the times of its shutter in place of the motion's functions."""
        if self.motion.is_still or self.camera is None:
            return self
        shutter = self.shutter
        middles = [middle for _, _, middle in shutter.bands(self.camera.height)]
        times = [shutter.time, *(time for middle in middles for time in shutter.times(middle))]
        return replace(self, motion=self.motion.sampled(times))

    def with_(self, **changes: Any) -> Capture:
        """A copy with some parts changed; those that are None stay as they are.

        Raises:
            InputError: an unknown part, or a value of the wrong kind.
        """
        for name in changes:
            if name not in self.__dataclass_fields__:
                raise InputError(unknown("part of a capture", name, [part.name for part in fields(self)]))
        given = {name: value for name, value in changes.items() if value is not None}
        return replace(self, **given) if given else self


class CaptureParts(TypedDict, total=False):
    """Parts of a capture as arguments by name beside `outputs` and `quality`; None: as the capture has it."""

    camera: Camera | None
    background: Background | Iterable[float] | None
    motion: Motion | None
    shutter: Shutter | None
    sensor: Sensor | None
    fog: Fog | None
    external_depth: ExternalDepth | None


def output_names(outputs: Any) -> tuple[str, ...]:
    """Names of outputs, each once, from one or several. Raises InputError for anything else, and for none."""
    try:
        names: tuple[Any, ...] = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    except TypeError:  # an array of no dimension, too, passes for an Iterable
        names = (outputs,)
    if not names:
        raise InputError("outputs is empty; name at least one, e.g. 'rgb'")
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"outputs must be one or more names, not {outputs!r}")
    return tuple(dict.fromkeys(names))


def _of_kind(name: str, value: Any, kind: type) -> Any:
    if value is not None and not isinstance(value, kind):
        raise InputError(f"{name} is {value!r}; it must be a {kind.__name__}")
    return value
