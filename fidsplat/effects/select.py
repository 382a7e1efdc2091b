"""The one place that decides what a scene calls for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from fidsplat.cameras import Camera
from fidsplat.effects.catalogue import CATALOGUE, Output
from fidsplat.effects.together import refuse_strangers
from fidsplat.errors import InputError, unknown
from fidsplat.quality import Quality
from fidsplat.sensor import Sensor
from fidsplat.surroundings import Background, Fog, Gradient, background_of

RGB = Output("rgb", 3, "float32")
OUTPUTS: dict[str, Output] = {
    "rgb": RGB,
    **{
        effect.output.name: effect.output
        for effect in CATALOGUE.values()
        if effect.output and effect.output.public
    },
}


@dataclass(frozen=True)
class FeatureSet:
    """What one picture calls for: names and small integers only, so that it can be a key.

    Numbers that change from view to view (intrinsics, poses, thresholds, background) are uniforms, never
    here.
    """

    slots: tuple[str, ...]
    """One effect per kind, in the fixed order camera, color, lowpass, stop, compose, footprint, background,
    arithmetic; then motion, shutter and double blending, if any."""
    taps: tuple[str, ...]
    """Sorted names of the planes beside rgb."""
    sh_degree: int
    samples: int
    setup_precision: str
    posts: tuple[str, ...] = ()
    """What changes rgb on its way out, in its order: fog, the steps of the sensor."""

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of all effects, those of outputs that others are made from among them."""
        return frozenset((*self.slots, *(output.name for output in self.outputs[1:]), *self.posts))

    @cached_property
    def outputs(self) -> tuple[Output, ...]:
        """Output images, rgb first, then those that others are made from."""
        needed = sorted({name for tap in self.taps for name in CATALOGUE[tap].needs})
        names = (*needed, *(tap for tap in self.taps if tap not in needed))
        effects = (CATALOGUE[name] for name in names)
        return (RGB, *(effect.output for effect in effects if effect.output))


class Traits(Protocol):
    """What of a cloud decides the kernels."""

    @property
    def sh_degree(self) -> int:
        """Degree of the colours that depend on the view; -1 for plain colours."""
        ...

    @property
    def has_planes(self) -> bool:
        """Whether splats are printed on planes."""
        ...

    @property
    def footprint(self) -> str:
        """`gaussian`, `box`, or `mixed` where there are splats of both kinds."""
        ...


def select(
    cloud: Traits,
    outputs: Iterable[str],
    quality: Quality,
    camera: Camera | None = None,
    moving: bool = False,
    exposed: bool = False,
    *,
    sensor: Sensor | None = None,
    fog: Fog | None = None,
    background: Background = (0.0, 0.0, 0.0),
) -> FeatureSet:
    """The features that a cloud, outputs, quality, camera (None: a pinhole) and so on call for. Values that
    mean nothing call for nothing.

    moving: groups of splats move by themselves. exposed: the picture is made of several poses.

    Raises:
        InputError: an output that nobody declares, or two effects that do not go together.
    """
    if isinstance(outputs, str):
        outputs = (outputs,)
    wanted = set(outputs)
    for name in wanted:
        if name not in OUTPUTS:
            raise InputError(unknown("output", name, OUTPUTS))
    foggy = fog is not None and fog.density > 0
    lowpass = "none" if cloud.footprint == "box" else quality.lowpass
    precision = quality.blend_precision
    refuse_strangers(foggy, camera, precision)
    layered = cloud.has_planes and quality.coplanar == "blend"
    pinhole = camera is None or camera.lens is None
    in_spheres = pinhole and cloud.footprint == "gaussian" and lowpass != "pixel"
    return FeatureSet(
        slots=(
            f"camera_{camera.lens.kind if camera is not None and camera.lens else 'pinhole'}",
            "color_rgb" if cloud.sh_degree < 0 else "color_sh",
            # boxes are filtered by their own footprint
            f"lowpass_{lowpass}",
            f"stop_{quality.stop_rule}",
            "compose_planes" if layered else "compose_ordered",
            f"footprint_{cloud.footprint}",
            f"background_{_behind(background, foggy)}",
            # short functions are float32's
            f"arithmetic_{'precise' if precision == 'float64' else quality.arithmetic}",
            *(("motion_groups",) if moving else ()),
            *(("shutter_exposure",) if exposed else ()),
            *(("shutter_rows",) if exposed and in_spheres else ()),
            *(("blend_double",) if precision == "float64" else ()),
        ),
        taps=tuple(sorted(wanted - {"rgb"})),
        sh_degree=max(cloud.sh_degree, 0),
        samples=quality.samples,
        setup_precision=quality.setup_precision,
        posts=(*(("fog",) if foggy else ()), *(() if sensor is None else sensor.steps)),
    )


def _behind(background: Background, foggy: bool) -> str:
    around = background_of(background)
    # behind everything fog is all there is
    if foggy or isinstance(around, tuple):
        return "constant"
    return "gradient" if isinstance(around, Gradient) else "panorama"
