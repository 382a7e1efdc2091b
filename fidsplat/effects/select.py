"""The one place that decides what a scene calls for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

from fidsplat.cameras import Orthographic
from fidsplat.cameras.lenses import Lens
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Gradient, Panorama
from fidsplat.capture.quality import Quality
from fidsplat.effects.catalogue import CATALOGUE, Output
from fidsplat.util.errors import InputError, unknown

RGB = Output("rgb", 3, "float32")
IMAGES: dict[str, Output] = {
    "rgb": RGB,
    **{effect.output.name: effect.output for effect in CATALOGUE.values() if effect.output},
}
"""all output images"""
OUTPUTS = {name: output for name, output in IMAGES.items() if output.public}
"""those that users ask for and backends render"""
OF_TWO = ("error",)
"""those that are made of two renderings (fidsplat/render/certified_error.py)"""

_KINDS = {Gradient: "gradient", Panorama: "panorama"}


@dataclass(frozen=True)
class FeatureSet:
    """What one picture calls for: names and small integers only, so that it can be a key.

    Numbers that change from view to view (intrinsics, poses, thresholds, background) are uniforms, never
    here.
    """

    slots: tuple[str, ...]
    """One effect per kind, in the fixed order camera, color, ellipsoids if any, lowpass, stop, a layer if
    any, compose, footprint, background, arithmetic; then motion, shutter, double blending and where tiles
    end, if any."""
    outputs: tuple[str, ...]
    """Sorted names of the outputs beside rgb."""
    sh_degree: int
    samples: int
    setup_precision: str
    posts: tuple[str, ...] = ()
    """What changes rgb on its way out, in its order: fog, the steps of the sensor."""

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of all effects, those of outputs that others are made from among them."""
        return frozenset((*self.slots, *(image.name for image in self.images[1:]), *self.posts))

    @cached_property
    def images(self) -> tuple[Output, ...]:
        """Output images, rgb first, then those that others are made from."""
        needed = sorted({name for output in self.outputs for name in CATALOGUE[output].needs})
        names = (*needed, *(name for name in self.outputs if name not in needed))
        effects = (CATALOGUE[name] for name in names)
        return (RGB, *(effect.output for effect in effects if effect.output))


class Traits(Protocol):
    """What of a cloud decides the kernels."""

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics; -1 for plain colours."""
        ...

    @property
    def has_coplanar_groups(self) -> bool:
        """Whether splats are printed on planes."""
        ...

    @property
    def footprint(self) -> str:
        """`gaussian`, `box`, or `mixed` where there are splats of both kinds."""
        ...

    @property
    def ellipsoids(self) -> str:
        """Which splats are 3D Gaussians: `none`, `some` or `all`."""
        ...


def select(cloud: Traits, capture: Capture) -> FeatureSet:
    """The features that a capture of a cloud calls for. Values that mean nothing call for nothing. Without a
    camera it is a pinhole.

    Raises:
        InputError: an output that nobody declares, or two effects that do not go together.
    """
    for name in capture.outputs:
        if name not in (*OUTPUTS, *OF_TWO):
            raise InputError(unknown("output", name, (*OUTPUTS, *OF_TWO)))
    quality, background = capture.quality, capture.backdrop
    lens = None if capture.camera is None else capture.camera.lens
    ellipsoid = _ellipsoid(cloud, quality, lens)
    if capture.external_depth is not None and capture.exposed:
        raise InputError(
            "a capture with external_depth must have a shutter with exposure_time=0 and readout=0"
        )
    # what filters itself needs no low-pass
    alone = cloud.ellipsoids == "all" and ellipsoid != "exact"
    filtered = cloud.footprint == "box" or alone
    lowpass = "none" if filtered else quality.lowpass
    double = quality.blend_precision == "float64"
    if double:
        _refuse_float64(lens, capture.foggy)
    flat = cloud.footprint == "gaussian" and not ellipsoid
    in_spheres = lens is None and flat and lowpass != "pixel"
    # harmonics of degree 0 do not depend on the view: they are colours (`SplatCloud.plain_colors`)
    sh_degree = max(cloud.sh_degree, 0)
    return FeatureSet(
        slots=(
            f"camera_{lens.kind if lens else 'pinhole'}",
            "color_sh" if sh_degree else "color_rgb",
            *((f"ellipsoid_{ellipsoid}",) if ellipsoid else ()),
            *(("ellipsoids_only",) if alone else ()),
            f"lowpass_{lowpass}",
            f"stop_{quality.stop_rule}",
            # before what composites, whose fragments it hides
            *(("external_depth",) if capture.external_depth is not None else ()),
            _composing(cloud, quality.order, one_depth_each=alone and not double),
            f"footprint_{cloud.footprint}",
            f"background_{_KINDS.get(type(background), 'constant')}",
            # short functions are float32's
            f"arithmetic_{'precise' if double else quality.arithmetic}",
            *(("motion_groups",) if capture.motion.groups else ()),
            *(("shutter_exposure",) if capture.exposed else ()),
            *(("shutter_rows",) if capture.exposed and in_spheres else ()),
            *(("blend_double",) if double else ()),
        ),
        outputs=tuple(sorted({*capture.outputs} - {"rgb", *OF_TWO})),
        sh_degree=sh_degree,
        samples=quality.samples,
        setup_precision=quality.setup_precision,
        posts=(*(("fog",) if capture.foggy else ()), *capture.sensor.steps),
    )


def with_termination_depths(features: FeatureSet) -> FeatureSet:
    """The same picture, of which blending tells where each tile was finished: what hides what of a store."""
    return replace(features, slots=(*features.slots, "termination_depths"))


def _composing(cloud: Traits, order: str, one_depth_each: bool) -> str:
    """The effect that composites: by splats' centres, or by depth at each pixel, with or without planes.

    Where every fragment has its centre's depth as float32, as the lists' keys are, both orders are the same,
    and nothing need wait.
    """
    if cloud.has_coplanar_groups:
        return "compose_ordered" if order == "centre" else "compose_coplanar"
    return "compose_pixel" if order == "pixel" and not one_depth_each else "compose_ordered"


def _ellipsoid(cloud: Traits, quality: Quality, lens: Lens | None) -> str:
    """How 3D Gaussians are drawn; empty if there are none."""
    if cloud.ellipsoids == "none":
        return ""
    # 3DGS knows pinholes and parallel rays alone
    return quality.ellipsoid if lens is None or isinstance(lens, Orthographic) else "exact"


def _refuse_float64(lens: Lens | None, foggy: bool) -> None:
    """Refuse to blend in float64 where rays are float32: better no picture than one that promises too much.

    Raises:
        InputError: it names both effects and what would do.
    """
    if foggy or not (lens is None or isinstance(lens, Orthographic)):
        what = "the fog's" if foggy or lens is None else f"a {lens.kind} lens's"
        raise InputError(
            f"blend_precision='float64' would promise too much: {what} rays are held in float32; take "
            "blend_precision='float32', or a pinhole without fog"
        )
