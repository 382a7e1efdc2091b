"""Causes of failed tag detection, with severities from 0 to 1, applied to views of a marker in a scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Motion, Shutter
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Fog
from fidsplat.capture.sensor import Sensor
from fidsplat.formats.files import load_splats
from fidsplat.markers import BoxEdge, Crumpled, Cylinder, Marker, Wear, marker
from fidsplat.markers.surfaces import SheetShape
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.captured import fetch_scene
from fidsplat.scenes.lights import Light, Lighting, PointLight, Sun
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.util.arguments import number
from fidsplat.util.response import to_colors
from fidsplat.worlds.greenhouse import AISLE, Greenhouse, facing

WIDTH, HEIGHT, FOV = 640, 480, math.radians(60.0)
EDGES = 6.0
"""distance of the camera without a cause, in edges of the code: an edge has about 90 pixels"""
INK, PAPER = Lighting.ink, Lighting.paper
"""reflectance of ink and paper"""
VARIANTS = 4
"""number of seeds of planks, wear and crumpled sheets, which views share to save time"""
_PRINT = tuple((float(to_colors(np.array(light), "srgb")),) * 3 for light in (INK, PAPER))
"""display colours of ink and paper"""
_COVER = 0.16, 0.3, 0.09
"""colour of an object in front of the marker"""


class MarkerSite(NamedTuple):
    """Captured scene with the position of its marker, in front of the figure and facing -z; y points down."""

    position: tuple[float, float, float]
    size: float
    """edge of the code in metres"""
    background: tuple[float, float, float]


GREENHOUSE = "greenhouse"
CAPTURED = {
    "biker": MarkerSite((-0.1, -1.6, -0.75), 0.3, (0.72, 0.74, 0.76)),
    "playbot": MarkerSite((0.0, -0.45, -0.75), 0.15, (0.16, 0.17, 0.2)),
}
"""captured scenes by name"""
SCENES = (GREENHOUSE, *CAPTURED)


@cache
def scene_of(name: str) -> tuple[Scene, np.ndarray, float]:
    """A scene without markers, and pose and size of its marker.

    Raises InputError as `fetch_scene`.
    """
    if name == GREENHOUSE:
        house = Greenhouse(rows=2, plants=6).scene
        pose = facing((-0.3, AISLE / 2, 0.8), (-1, 0))
        return Scene((SplatCloud.concatenate(house.clouds),), background=house.background), pose, 0.16
    place = CAPTURED[name]
    scene = Scene((load_splats(fetch_scene(name)),), background=place.background)
    return scene, rigid_matrix(place.position), place.size


@cache
def marker_of(
    spec: str, size: float, lit: bool = False, shape: SheetShape | None = None, wear: Wear | None = None
) -> Marker:
    """A marker with the colours of ink and paper; lit: black and white, for `Lighting`."""
    black, white = ((0.0,) * 3, (1.0,) * 3) if lit else _PRINT
    return marker(spec, size=size, black=black, white=white, shape=shape, wear=wear)


@cache
def placed_in(scene: str, spec: str) -> PlacedMarker:
    _, pose, size = scene_of(scene)
    return PlacedMarker(marker_of(spec, size), pose)


@lru_cache(32)
def _changed(placed: PlacedMarker, light: Lighting | None = None, **parts: Any) -> PlacedMarker:
    """The marker in a light, or with a shape or wear."""
    printed = placed.marker
    return replace(
        placed, marker=marker_of(printed.spec, printed.size, light is not None, **parts), light=light
    )


@lru_cache(8)
def _assembled(
    base: Scene,
    placed: PlacedMarker,
    cover: SplatCloud | None,
    lights: tuple[Light, ...],
    camera: Camera | None,
) -> Scene:
    """Scene with a placed marker, cover and lights; cached, so that its light is computed only once."""
    clouds = base.clouds if cover is None else (*base.clouds, cover.transformed(placed.pose))
    return replace(base, clouds=clouds, markers=(placed,), lights=lights, camera=camera)


@dataclass(frozen=True, eq=False)
class MarkerView:
    """A test image: a scene, the pose of a marker in it, and the camera's distance, angles and settings."""

    scene: Scene
    """scene without the marker"""
    placed: PlacedMarker
    seed: int
    """seed of noise, wear and covers"""
    edges: float
    """distance in edges of the code"""
    tilt: float
    """radians between the marker's normal and the direction to the camera"""
    azimuth: float
    """direction of the tilt in radians; 0 rotates about the vertical"""
    roll: float
    aim: tuple[float, float]
    """point of the marker's plane at the centre of the image, relative to the distance"""
    capture: Capture
    """capture without the camera's pose"""
    cover: SplatCloud | None = None
    """object in front of the marker, in the marker's frame"""
    lights: tuple[Light, ...] = ()
    defocus: float = 0.0
    """radius in pixels of the disk of defocus"""

    @property
    def camera(self) -> Camera:
        distance = self.edges * self.placed.marker.size
        sine = math.sin(self.tilt)
        towards = np.array(
            [sine * math.cos(self.azimuth), sine * math.sin(self.azimuth), -math.cos(self.tilt)]
        )
        up = (math.sin(self.roll), -math.cos(self.roll), 0.0)
        target = distance * np.array([*self.aim, 0.0])
        camera = Camera.look_at(WIDTH, HEIGHT, FOV, distance * towards + target, target, up)
        lens = None if self.capture.camera is None else self.capture.camera.lens
        pose = camera.world_to_camera @ np.linalg.inv(self.placed.pose)
        return replace(camera.with_pose(pose), lens=lens)

    @property
    def complete_scene(self) -> Scene:
        """The scene with the marker, its lights and the object that covers it."""
        light = self.placed.light
        camera = self.camera if isinstance(light, Lighting) and light.view == "camera" else None
        return _assembled(self.scene, self.placed, self.cover, self.lights, camera)

    @property
    def complete_capture(self) -> Capture:
        return self.capture.with_(camera=self.camera)

    def changed(self, **parts: Any) -> MarkerView:
        """The view with changed fields of its capture."""
        return replace(self, capture=self.capture.with_(**parts))

    def exposed(self, **parts: Any) -> MarkerView:
        """The view with a sensor that integrates linear light and has an sRGB response."""
        return self.changed(sensor=Sensor(decode="srgb", response="srgb", seed=self.seed, **parts))

    def moving(self, pixels: float, shutter: Shutter) -> MarkerView:
        """The view with a camera that moves sideways, so that the marker moves by this number of pixels per
        second at time 0."""
        camera = self.camera
        speed = pixels * self.edges * self.placed.marker.size / camera.fx
        angle = 2 * math.pi * self.rng.random()
        step = speed * np.array([math.cos(angle), math.sin(angle), 0.0])

        def world_to_camera(time: float) -> np.ndarray:
            return rigid_matrix(step * time) @ camera.world_to_camera

        return self.changed(motion=Motion(world_to_camera), shutter=shutter)

    @property
    def rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)


def view_of(scene: str, spec: str, seed: str) -> MarkerView:
    """A view without a cause, with random distance, tilt, roll and aim.

    Views with equal seeds have equal poses for all specs, causes and severities.
    """
    base, _, _ = scene_of(scene)
    rng = np.random.default_rng([*seed.encode()])
    edges = EDGES * math.exp(rng.uniform(-0.15, 0.15))
    tilt, azimuth = math.radians(rng.uniform(0, 40)), math.radians(rng.uniform(-25, 25))
    roll, aim = math.radians(rng.uniform(-20, 20)), rng.uniform(-0.05, 0.05, 2)
    return MarkerView(
        base,
        placed_in(scene, spec),
        int(rng.integers(2**31)),
        edges,
        tilt * rng.choice((-1, 1)),
        azimuth,
        roll,
        (float(aim[0]), float(aim[1])),
        Capture(background=base.background),
    )


@dataclass(frozen=True)
class Cause:
    """Cause of failed detection: maps a severity from 0 to 1 to an amount in physical units, and applies it
    to a view."""

    title: str
    group: str
    """figure that contains the cause"""
    amount: Callable[[float], float]
    """function from a severity to the amount in `unit`"""
    form: str
    """format of the amount, e.g. "{:.0f}" """
    unit: str
    change: Callable[[MarkerView, float], MarkerView]
    """function from a view and an amount to the changed view"""

    def apply(self, view: MarkerView, severity: float) -> MarkerView:
        """Apply the cause to a view. Raises InputError for a severity outside 0 to 1."""
        number("severity", severity, "a number from 0 to 1", 0, 1)
        return self.change(view, self.amount(severity))

    def text(self, severity: float) -> str:
        """Amount of a severity as text, without unit."""
        return self.form.format(self.amount(severity))


def _linear(last: float, first: float = 0.0) -> Callable[[float], float]:
    return lambda severity: first + severity * (last - first)


def _geometric(first: float, last: float) -> Callable[[float], float]:
    return lambda severity: first * (last / first) ** severity


def _distance(view: MarkerView, edges: float) -> MarkerView:
    """Move the camera to a distance in edges of the code."""
    return replace(view, edges=view.edges * edges / EDGES)


def _angle(view: MarkerView, degrees: float) -> MarkerView:
    """Move the camera to this angle [degrees] from the marker's normal."""
    return replace(view, tilt=math.copysign(math.radians(degrees), view.tilt))


def _lens(view: MarkerView, k1: float) -> MarkerView:
    """Distort the image by the radial coefficient -k1; the marker is near a corner, where distortion is
    large."""
    signs = view.rng.choice((-1.0, 1.0), 2)
    view = replace(view, aim=(float(0.36 * signs[0]), float(0.24 * signs[1])), tilt=view.tilt / 4)
    return view.changed(camera=replace(view.camera, lens=BrownConrady(k1=-k1)))


def _blur(view: MarkerView, pixels: float) -> MarkerView:
    """Move the camera during the exposure, so that the image of the marker moves by this number of pixels."""
    return view.moving(pixels, Shutter(exposure_time=1.0, sub_poses=max(2, math.ceil(pixels / 2))))


def _rolling(view: MarkerView, pixels: float) -> MarkerView:
    """Move the camera during the readout, so that the image of the marker moves by these pixels per frame."""
    return view.moving(pixels, Shutter(readout=1.0, rows_per_band=6))


def _noise(view: MarkerView, electrons: float) -> MarkerView:
    """Add shot noise of a sensor with this full well in electrons."""
    return view.exposed(full_well=electrons)


def _underexposed(view: MarkerView, fraction: float, gain: float = 1.0) -> MarkerView:
    """Reduce the exposure to a fraction of the light, with shot noise and read noise."""
    return view.exposed(exposure=fraction, full_well=10_000.0, read_noise=5.0, gain=gain)


def _overexposed(view: MarkerView, factor: float) -> MarkerView:
    """Multiply the exposure by a factor; light above 1 saturates."""
    return view.exposed(exposure=factor)


def _fog(view: MarkerView, transmittance: float) -> MarkerView:
    """Add fog with this transmittance between camera and marker, 0 to 1."""
    distance = view.edges * view.placed.marker.size
    return view.changed(fog=Fog(-math.log(transmittance) / distance))


def _covered(view: MarkerView, fraction: float) -> MarkerView:
    """Cover a fraction of the code by a dark leaf, from a random side."""
    size, rng = view.placed.marker.size, view.rng
    angle = math.pi / 2 * int(rng.integers(4)) + rng.uniform(-0.2, 0.2)
    # the leaf is as long as two edges of the code; its end covers the fraction
    middle = size * (0.5 - fraction + 1.0)
    position = (middle * math.cos(angle), middle * math.sin(angle), -0.02 * size)
    quaternion = [math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]
    leaf = SplatCloud([position], [quaternion], [(size, 0.8 * size)], [1.0], colors=[_COVER])
    return replace(view, cover=leaf.with_boxes())


def _transparent(view: MarkerView, opacity: float) -> MarkerView:
    """Multiply the opacities of the marker's splats by a factor, 0 to 1."""
    printed, cloud = view.placed.marker, view.placed.marker.cloud
    thin = SplatCloud(
        cloud.world_means(), cloud.quats, cloud.scales, opacity * cloud.opacities, colors=cloud.colors
    ).with_coplanar_groups(cloud.coplanar_groups)
    thin = thin.with_boxes(cloud.boxes)
    return replace(view, placed=replace(view.placed, marker=replace(printed, cloud=thin)))


def _defocused(view: MarkerView, radius: float) -> MarkerView:
    """Blur the image by a disk with a radius in pixels."""
    return replace(view, defocus=radius)


def _direction(placed: PlacedMarker, vector: tuple[float, float, float]) -> tuple[float, float, float]:
    """World direction of a vector in the marker's frame."""
    x, y, z = (placed.pose[:3, :3] @ np.array(vector)).tolist()
    return x, y, z


def _backlight(view: MarkerView, fraction: float) -> MarkerView:
    """Reduce the light of the marker to a fraction of that of its surroundings, for which the camera is
    exposed."""
    return replace(view, placed=_changed(view.placed, Lighting(exposure=fraction)))


def _shadow(view: MarkerView, ratio: float) -> MarkerView:
    """Cast shadows of planks; ratio: irradiance by the sun over irradiance in the shade. The camera is
    exposed for sunlit areas."""
    cover, sun = _planks(view.placed.marker.size, view.seed % VARIANTS)
    # paper in the sun is as bright as paper without a cause
    light = Lighting(source="lights", exposure=1 / (1 + ratio))
    facing = sun[2] / math.hypot(*sun)
    lights = (
        Sun(direction=_direction(view.placed, sun), intensity=ratio * math.pi / facing),
        Sun(direction=_direction(view.placed, (0, 0, 1)), intensity=1.1 * math.pi, angle=2.0, samples=6),
    )
    return replace(view, placed=_changed(view.placed, light), cover=cover, lights=lights)


@cache
def _planks(size: float, number: int) -> tuple[SplatCloud, tuple[float, float, float]]:
    """Planks above and in front of a marker, outside the camera's view, and the direction of the sunlight
    through them, in the marker's frame."""
    sun = np.array([0.35, 0.75, 0.56])
    rng = np.random.default_rng(number)
    angle = rng.uniform(-0.5, 0.5)
    across = np.cross(sun, [math.sin(angle), -math.cos(angle), 0.0])
    u = across / np.linalg.norm(across)
    v = np.cross(sun / np.linalg.norm(sun), u)
    frame = matrix_to_quaternion(np.stack([u, v, np.cross(u, v)], 1))
    start = rng.uniform()
    middles = [size * (-4 * sun + 0.6 * (k + start) * v) for k in range(-5, 5)]
    planks = SplatCloud(
        middles, [frame] * 10, [(2 * size, 0.15 * size)] * 10, np.ones(10), colors=[_COVER] * 10
    )
    return planks.with_boxes(), tuple(sun.tolist())


def _glare(view: MarkerView, ratio: float) -> MarkerView:
    """Add a lamp that a laminated marker reflects into the camera; ratio: irradiance by the lamp over the
    other light."""
    placed = _changed(view.placed, Lighting("lights", roughness=0.25, view="camera"))
    distance = view.edges * placed.marker.size
    towards = placed.pose[:3, :3].T @ (view.camera.position - placed.pose[:3, 3])
    offset = 0.25 * placed.marker.size * view.rng.uniform(-1, 1, 2)  # middle of the highlight
    lamp = np.array([2 * offset[0] - towards[0], 2 * offset[1] - towards[1], towards[2]])
    position = tuple((placed.pose[:3, :3] @ lamp + placed.pose[:3, 3]).tolist())
    sky = Sun(direction=_direction(placed, (0, 0.87, 0.5)), intensity=2 * math.pi)
    light = PointLight(position=position, intensity=ratio * math.pi * distance**2)
    return replace(view, placed=placed, lights=(sky, light))


def _dusk(view: MarkerView, fraction: float) -> MarkerView:
    """Reduce the light to a fraction, and compensate it by gain."""
    return _underexposed(view, fraction, 1 / fraction)


def _flare(view: MarkerView, fraction: float) -> MarkerView:
    """Add veiling glare from a window outside of the image, as a fraction of the light."""
    return view.exposed(veiling_glare=fraction, glare_light=(0.6,) * 3)


def _cylinder(view: MarkerView, degrees: float) -> MarkerView:
    """Bend the code to an arc of this many degrees on a cylinder."""
    radius = view.placed.marker.size / math.radians(max(degrees, 1e-5))
    axis = "xy"[view.seed % 2]
    return replace(view, placed=_changed(view.placed, shape=Cylinder(radius, axis=axis)))


def _crumpled(view: MarkerView, height: float) -> MarkerView:
    """Crumple the sheet to a height in edges of the code."""
    size = view.placed.marker.size
    sheet = Crumpled(height * size, size, seed=view.seed % VARIANTS)
    return replace(view, placed=_changed(view.placed, shape=sheet))


def _box_edge(view: MarkerView, fraction: float) -> MarkerView:
    """Bend a fraction of the code around the edge of a box."""
    size, axis = view.placed.marker.size, "xy"[view.seed % 2]
    edge = BoxEdge(0.03 * size, (0.5 - fraction) * size, axis=axis)
    return replace(view, placed=_changed(view.placed, shape=edge))


def _faded(view: MarkerView, contrast: float) -> MarkerView:
    """Reduce the contrast of the print to a fraction."""
    return _worn("fading")(view, 1 - contrast)


def _worn(name: str) -> Callable[[MarkerView, float], MarkerView]:
    """Function that changes one field of `Wear`."""
    return lambda view, severity: replace(
        view, placed=_changed(view.placed, wear=Wear(**{name: severity}, seed=view.seed % VARIANTS))
    )


GEOMETRY, CAMERA, LIGHT = "geometry", "camera", "light"
SHAPE, WEAR = "shape", "print and wear"
CAUSES = {
    "distance": Cause("distance", GEOMETRY, _geometric(EDGES, 60), "{:.0f}", "edges", _distance),
    "angle": Cause("angle to the normal", GEOMETRY, _linear(85), "{:.0f}", "degrees", _angle),
    "covered": Cause("covered side", GEOMETRY, _linear(0.15), "{:.2f}", "of the code", _covered),
    "fog": Cause("fog", GEOMETRY, _geometric(1, 0.01), "{:.2f}", "of the contrast", _fog),
    "opacity": Cause("translucent marker", GEOMETRY, _linear(0.02, 1.0), "{:.2f}", "opacity", _transparent),
    "blur": Cause("motion blur", CAMERA, _linear(32), "{:.0f}", "px", _blur),
    "rolling": Cause("rolling shutter", CAMERA, _linear(80), "{:.0f}", "px per frame", _rolling),
    "defocus": Cause("defocus", CAMERA, _linear(12), "{:.1f}", "px radius", _defocused),
    "noise": Cause("shot noise", CAMERA, _geometric(10_000, 1), "{:.0f}", "electrons", _noise),
    "dark": Cause("under-exposure", CAMERA, _geometric(1, 1 / 300), "{:.3f}", "of the light", _underexposed),
    "bright": Cause("over-exposure", CAMERA, _geometric(1, 40), "{:.1f}", "x light", _overexposed),
    "lens": Cause("distortion near a corner", CAMERA, _linear(0.35), "-{:.2f}", "k1", _lens),
    "backlight": Cause("backlight", LIGHT, _geometric(1, 1 / 300), "{:.3f}", "of the light", _backlight),
    "shadow": Cause("shadows of planks", LIGHT, _geometric(0.1, 30), "{:.1f}", "sun / shade", _shadow),
    "glare": Cause("glare of a lamp", LIGHT, _geometric(0.01, 3), "{:.2f}", "lamp / light", _glare),
    "dusk": Cause("dusk", LIGHT, _geometric(1, 1 / 3000), "{:.4f}", "of the light", _dusk),
    "flare": Cause("veiling glare", LIGHT, _linear(0.98), "{:.2f}", "of the light", _flare),
    "cylinder": Cause("cylinder", SHAPE, _linear(140), "{:.0f}", "degrees of arc", _cylinder),
    "crumpled": Cause("crumpled", SHAPE, _linear(0.1), "{:.2f}", "edges high", _crumpled),
    "box edge": Cause("around a box", SHAPE, _linear(0.2), "{:.2f}", "of the code", _box_edge),
    "bleed": Cause("ink bleed", WEAR, _linear(1), "{:.2f}", "half modules", _worn("bleed")),
    "coarse": Cause("coarse print", WEAR, _linear(1), "{:.2f}", "severity", _worn("coarseness")),
    "fading": Cause("fading", WEAR, _geometric(1, 0.01), "{:.2f}", "contrast left", _faded),
    "dirt": Cause("dirt", WEAR, _linear(0.2), "{:.2f}", "of the sheet", _worn("dirt")),
    "drops": Cause("water drops", WEAR, _linear(1), "{:.2f}", "of the sheet", _worn("drops")),
    "scratches": Cause("scratches", WEAR, _linear(0.3), "{:.2f}", "severity", _worn("scratches")),
    "tear": Cause("torn corner", WEAR, _linear(0.25), "{:.2f}", "severity", _worn("tear")),
    "fold": Cause("folded corner", WEAR, _linear(0.6), "{:.2f}", "severity", _worn("fold")),
}
"""causes by name"""
