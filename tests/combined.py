"""Every effect as a switch, and any set of them that does not contradict itself as one image."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from agreement import random_splats

import fidsplat as fs
from fidsplat.backends.prepare import view_of
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.effects import OUTPUTS, FeatureSet, select
from fidsplat.selftest.agreement import compare

SIZE = (37, 22)


def rotating(time: float) -> np.ndarray:
    """A camera that turns and moves on."""
    pose, angle = np.eye(4), 0.5 * time
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    pose[0, 3] = -0.2 * time
    return pose


def sliding(time: float) -> np.ndarray:
    """A group that moves to the right."""
    pose = np.eye(4)
    pose[0, 3] = 0.4 * time
    return pose


def with_ellipsoids(cloud: fs.SplatCloud) -> fs.SplatCloud:
    """The cloud with as many 3D Gaussians among its splats."""
    flat = random_splats(len(cloud), 22, depth=(0.8, 4.0), scale=(0.05, 0.5), across=1.2)
    scales = np.column_stack([flat.scales, flat.scales[::-1, 0]])
    thick = fs.SplatCloud(
        flat.means, flat.quats, scales, flat.opacities, colors=flat.colors, labels=flat.labels
    )
    return fs.SplatCloud.concatenate([cloud, thick])


@dataclass(frozen=True)
class Switch:
    """One effect. Of a `kind` an image has one at most; fog is a background, since nothing else is visible
    behind it."""

    kind: str
    camera: fs.Camera | None = None
    quality: Mapping[str, Any] = field(default_factory=dict)
    sensor: Mapping[str, Any] = field(default_factory=dict)
    shutter: Mapping[str, Any] = field(default_factory=dict)
    arguments: Mapping[str, Any] = field(default_factory=dict)
    cloud: Callable[[fs.SplatCloud], fs.SplatCloud] | None = None
    output: str | None = None


_PANORAMA = fs.Panorama(np.random.default_rng(5).random((8, 16, 3)).astype(np.float32))
_FIXED = {
    "distortion": Switch(
        "lens", fs.Camera.pinhole(*SIZE, 30.0, 30.0, 18.0, 11.0, lens=fs.BrownConrady(-0.2, 0.05, p1=0.01))
    ),
    "fisheye": Switch("lens", fs.Camera.fisheye(*SIZE, math.radians(170))),
    "equirectangular": Switch("lens", fs.Camera.equirectangular(*SIZE)),
    "orthographic": Switch("lens", fs.Camera.orthographic(*SIZE, 4.0)),
    "motion blur": Switch("exposure time", shutter={"exposure_time": 0.3, "sub_poses": 2}),
    "rolling shutter": Switch("readout", shutter={"readout": 0.4, "rows_per_band": 8}),
    "moving group": Switch("groups", arguments={"groups": {0: sliding}}),
    "spherical harmonics": Switch("colour"),
    "planes": Switch(
        "planes", cloud=lambda cloud: cloud.with_coplanar_groups(np.arange(len(cloud)) // 4 - 1)
    ),
    "boxes": Switch("footprint", cloud=lambda cloud: cloud.with_boxes()),
    "boxes and Gaussians": Switch(
        "footprint", cloud=lambda cloud: cloud.with_boxes(np.arange(len(cloud)) // 4 % 2 == 0)
    ),
    "ellipsoids": Switch("ellipsoids", cloud=with_ellipsoids),
    "exact ellipsoids": Switch("ellipsoids", cloud=with_ellipsoids, quality={"ellipsoid": "exact"}),
    "antialiased ellipsoids": Switch(
        "ellipsoids", cloud=with_ellipsoids, quality={"ellipsoid": "ewa_antialiased"}
    ),
    "low-pass none": Switch("lowpass", quality={"lowpass": "none"}),
    "low-pass pixel": Switch("lowpass", quality={"lowpass": "pixel"}),
    "order by pixel": Switch("planes", quality={"order": "pixel"}),
    # it drops single fragments, which a plane does not have
    "stop exclusive": Switch(
        "planes", quality={"stop_rule": "exclusive", "transmittance_stop": 1e-2, "order": "centre"}
    ),
    "2 x 2 samples": Switch("samples", quality={"samples": 2}),
    "set-up in float32": Switch("set-up", quality={"projection_precision": "float32"}),
    "fast arithmetic": Switch("arithmetic", quality={"arithmetic": "fast"}),
    "precise arithmetic": Switch("arithmetic", quality={"arithmetic": "precise"}),
    "fog": Switch("background", arguments={"fog": fs.Fog(0.2, (0.6, 0.65, 0.7))}),
    "gradient": Switch("background", arguments={"background": fs.Gradient((0.2, 0.4, 0.9), (0.4, 0.3, 0.1))}),
    "panorama": Switch("background", arguments={"background": _PANORAMA}),
    "sensor exposure": Switch("sensor exposure", sensor={"exposure": 1.5}),
    "decoding": Switch("decoding", sensor={"decode": "srgb"}),
    "glare": Switch("glare", sensor={"veiling_glare": 0.2, "glare_light": (0.1, 0.5, 0.9)}),
    "saturation": Switch("saturation", sensor={"saturation": 0.6}),
    "white balance": Switch("white balance", sensor={"white_balance": (0.7, 1.0, 1.5)}),
    "vignetting": Switch("vignetting", sensor={"vignetting": (-0.3, 0.05)}),
    "noise": Switch("noise", sensor={"full_well": 1000.0, "read_noise": 3.0, "seed": 4}),
    "gain": Switch("gain", sensor={"gain": 0.5}),
    "gamma": Switch("response", sensor={"response": 2.2}),
    "srgb": Switch("response", sensor={"response": "srgb"}),
    "response table": Switch("response", sensor={"response": (0.0, 0.9, 1.0)}),
    "8 bits": Switch("bits", sensor={"bits": 8}),
}
SWITCHES = {
    **_FIXED,
    **{f"output {name}": Switch(f"output {name}", output=name) for name in OUTPUTS if name != "rgb"},
}
COARSE = ("set-up",)
"""kinds for which the reference has no error bound"""
LENSES = [name for name, switch in SWITCHES.items() if switch.kind == "lens"]


def is_compatible(names: Iterable[str]) -> bool:
    """Whether no two of them are of one kind."""
    kinds = [SWITCHES[name].kind for name in names]
    return len(kinds) == len(set(kinds))


def all_effects(lens: str | None) -> tuple[str, ...]:
    """All effects behind that lens (None: a pinhole); of those that exclude each other one, another for each
    lens. None is coarse, so that images are compared closely."""
    kinds: dict[str, list[str]] = {}
    for name, switch in SWITCHES.items():
        kinds.setdefault(switch.kind, []).append(name)
    turn = [None, *LENSES].index(lens)
    chosen = [names[turn % len(names)] for kind, names in kinds.items() if kind not in ("lens", *COARSE)]
    return (*([lens] if lens else []), *chosen)


@cache
def _cloud(degree: int | None) -> fs.SplatCloud:
    return random_splats(24, 21, depth=(0.8, 4.0), scale=(0.05, 0.5), across=1.2, sh_degree=degree)


@dataclass(frozen=True)
class Combination:
    """Features that a set of switches requests."""

    cloud: fs.SplatCloud
    capture: fs.Capture

    def features(self, *more: str) -> FeatureSet:
        """The requested features, and more outputs."""
        return select(self.cloud, self.capture.with_(outputs=(*self.capture.outputs, *more)))


def combination(names: Iterable[str]) -> Combination:
    """The image in which all of them are switched on."""
    chosen = [SWITCHES[name] for name in names]
    cloud = _cloud(2 if "spherical harmonics" in names else None)
    camera = fs.Camera.pinhole(*SIZE, 30.0, 30.0, 18.0, 11.0)
    merged: dict[str, dict[str, Any]] = {"quality": {}, "sensor": {}, "shutter": {}, "arguments": {}}
    for switch in chosen:
        camera = switch.camera or camera
        cloud = switch.cloud(cloud) if switch.cloud else cloud
        for name, into in merged.items():
            into.update(getattr(switch, name))
    requested = merged["arguments"]
    capture = fs.Capture(
        camera,
        ("rgb", *(switch.output for switch in chosen if switch.output)),
        fs.Quality().with_(**merged["quality"]),
        requested.get("background", (0.1, 0.2, 0.3)),
        fs.Motion(rotating if merged["shutter"] else None, requested.get("groups", {})),
        fs.Shutter(**merged["shutter"]),
        fs.Sensor(**merged["sensor"]),
        requested.get("fog"),
    )
    return Combination(cloud, capture)


def assert_renders(renderer: fs.Renderer, names: Iterable[str]) -> None:
    """It builds, it renders, and all its images are the reference's within tolerance and error bound."""
    requested = combination(names)
    frame = renderer.render(requested.cloud, requested.capture)
    view = view_of(requested.capture, requested.cloud.origin)
    reference = ReferenceBackend()
    expected = (
        reference.pipeline(requested.features("alpha"))
        .render_view(reference.upload(requested.cloud), view)
        .arrays_of(0)
    )
    differences = compare(frame, expected, frame.outputs)
    if any(SWITCHES[name].kind in COARSE for name in names):
        assert all(one.finite for one in differences)
        assert np.quantile(np.abs(frame["rgb"] - expected["rgb"]), 0.95) < 0.5 / 255
        return
    wrong = [replace(one, risky=0.0) for one in differences if not (one.finite and one.excess <= 0)]
    assert not wrong, wrong
