"""Selection of the effects that a capture of a cloud requires, for all backends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from fidsplat.cameras import Orthographic
from fidsplat.cameras.lenses import Lens, camera_effect
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Gradient, Panorama
from fidsplat.capture.quality import Quality
from fidsplat.effects.catalogue import CATALOGUE, DERIVED_OUTPUTS, OUTPUTS, RGB, Output
from fidsplat.effects.extensions import EXTENSIONS, load_extensions
from fidsplat.splats.properties import CloudProperties
from fidsplat.util.errors import InputError, unknown

_BACKGROUND_KINDS = {Gradient: "gradient", Panorama: "panorama"}


@dataclass(frozen=True)
class FeatureSet:
    """Effects of a frame, as names and small integers, so that it can be a cache key. Numbers that change
    from view to view (intrinsics, poses, thresholds, background) are uniforms instead."""

    effects: tuple[str, ...]
    """One effect of each kind in a fixed order: camera, color, ellipsoid (optional), lowpass, stop, external
    depth (optional), order, footprint, background, arithmetic; then optional effects."""
    outputs: tuple[str, ...]
    """Sorted names of the outputs other than rgb."""
    sh_degree: int
    samples: int
    projection_precision: str
    post_steps: tuple[str, ...] = ()
    """Steps that change rgb after blending, in order: fog, then sensor steps."""

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of all effects, including outputs that are inputs of other outputs."""
        return frozenset((*self.effects, *(image.name for image in self.images[1:]), *self.post_steps))

    @cached_property
    def images(self) -> tuple[Output, ...]:
        """Output images: rgb, then inputs of other outputs, then the other outputs."""
        needed: set[str] = set()
        for name in self.outputs:
            needed.update(CATALOGUE[name].needs)
        images = [RGB]
        for name in (*sorted(needed), *self.outputs):
            output = CATALOGUE[name].output
            if output is not None and output not in images:
                images.append(output)
        return tuple(images)


def select(cloud: CloudProperties, capture: Capture) -> FeatureSet:
    """Select the effects that a capture of a cloud requires, for a pinhole if the capture has no camera.
    Raises InputError for an unknown output or incompatible effects."""
    _load_extensions_of(capture)
    for name in capture.outputs:
        if name not in (*OUTPUTS, *DERIVED_OUTPUTS):
            raise InputError(unknown("output", name, (*OUTPUTS, *DERIVED_OUTPUTS)))
    quality, background = capture.quality, capture.rendered_background
    lens = None if capture.camera is None else capture.camera.lens
    ellipsoid = _ellipsoid(cloud, quality, lens)
    if capture.external_depth is not None and capture.has_sub_frames:
        shutter = capture.shutter
        raise InputError(
            "a capture with external_depth must have a shutter with exposure_time=0 and readout=0, got "
            f"{shutter.exposure_time:g} and {shutter.readout:g}"
        )
    # box splats and EWA have their own low-pass filter
    ewa_only = cloud.ellipsoids == "all" and ellipsoid != "exact"
    filtered = cloud.footprint == "box" or ewa_only
    lowpass = "none" if filtered else quality.lowpass
    double = quality.blend_precision == "float64"
    half = quality.blend_precision == "float16"
    if double:
        _refuse_float64(lens, capture.has_fog)
    if half and capture.has_fog:
        raise InputError(
            "blend_precision must be 'float32' with fog, whose light is summed in float32, got 'float16'; "
            "use blend_precision='float32'"
        )
    flat = cloud.footprint == "gaussian" and not ellipsoid
    bounded_by_spheres = lens is None and flat and lowpass != "pixel"
    # harmonics of degree 0 do not depend on the view and are rendered as colours (`SplatCloud.plain_colors`)
    sh_degree = max(cloud.sh_degree, 0)
    return FeatureSet(
        effects=(
            camera_effect(lens),
            "color_sh" if sh_degree else "color_rgb",
            *((f"ellipsoid_{ellipsoid}",) if ellipsoid else ()),
            *(("ellipsoids_only",) if ewa_only else ()),
            f"lowpass_{lowpass}",
            f"stop_{quality.stop_rule}",
            # the surface is composited among the fragments of the next effect
            *(("external_depth",) if capture.external_depth is not None else ()),
            _compositing(cloud, quality.order, equal_depths=ewa_only and not double),
            f"footprint_{cloud.footprint}",
            f"background_{_BACKGROUND_KINDS.get(type(background), 'constant')}",
            # float64 blending requires precise functions; half precision suffices with approximate ones
            f"arithmetic_{'precise' if double else 'approximate' if half else quality.arithmetic}",
            *(("motion_groups",) if capture.motion.groups else ()),
            *(("shutter_exposure",) if capture.has_sub_frames else ()),
            *(("sub_frame_culling",) if capture.has_sub_frames and bounded_by_spheres else ()),
            *(("blend_double",) if double else ("blend_half",) if half else ()),
        ),
        outputs=tuple(sorted({*capture.outputs} - {"rgb", *DERIVED_OUTPUTS})),
        sh_degree=sh_degree,
        samples=quality.samples,
        projection_precision=quality.projection_precision,
        post_steps=(*(("fog",) if capture.has_fog else ()), *capture.sensor.steps),
    )


def _load_extensions_of(capture: Capture) -> None:
    """Load extensions if the capture requests an unknown name. Raises InputError for an unknown sensor step,
    or for a wrong number of its values."""
    steps = capture.sensor.extra
    if not {*capture.outputs, *steps} <= {*OUTPUTS, *DERIVED_OUTPUTS, *EXTENSIONS}:
        load_extensions()
    for name, values in steps.items():
        step = EXTENSIONS.get(name)
        if step is None or step.output is not None:
            names = [name for name, known in EXTENSIONS.items() if known.output is None]
            raise InputError(unknown("sensor step", name, names))
        if len(values) != len(step.uniforms):
            form = f"{name}:{','.join(step.uniforms)}" if step.uniforms else name
            raise InputError(f"sensor: a step of extra_steps must be {form}, got {len(values)} numbers")


def with_termination_depths(features: FeatureSet) -> FeatureSet:
    """Add the termination depth of each tile, for occlusion culling of stores."""
    return replace(features, effects=(*features.effects, "termination_depths"))


def _compositing(cloud: CloudProperties, order: str, equal_depths: bool) -> str:
    """Select the compositing effect: by centre depth or by fragment depth, with or without layers of coplanar
    groups. equal_depths: whether all fragments of a splat have the depth of its centre; both orders are equal
    then, and the effect without a k-buffer suffices."""
    if cloud.has_coplanar_groups:
        orders = {"centre": "order_centre", "auto": "order_coplanar", "pixel": "order_coplanar_pixel"}
        return orders[order]
    return "order_pixel" if order == "pixel" and not equal_depths else "order_centre"


def _ellipsoid(cloud: CloudProperties, quality: Quality, lens: Lens | None) -> str:
    """Projection of 3D Gaussians; empty for a cloud without 3D Gaussians."""
    if cloud.ellipsoids == "none":
        return ""
    # EWA projection is defined for pinholes and parallel rays
    return quality.ellipsoid if lens is None or isinstance(lens, Orthographic) else "exact"


def _refuse_float64(lens: Lens | None, has_fog: bool) -> None:
    """Raise InputError for float64 blending of float32 rays, which limit its accuracy."""
    if has_fog or not (lens is None or isinstance(lens, Orthographic)):
        what = "the fog's" if has_fog or lens is None else f"a {lens.kind} lens's"
        raise InputError(
            f"blend_precision='float64' must have rays in float64, got {what} rays in float32; use "
            "blend_precision='float32', or a pinhole without fog"
        )
