"""Lighting of markers: colours of their splats from the light of the scene. Panoramas measure the light
around a marker, and shadow maps the visibility of explicit lights. Boxes are split where the light changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.lenses import Orthographic
from fidsplat.render.irradiance import LightField
from fidsplat.render.reflection import Gloss, fit_harmonics, fresnel, gloss, lobe, view_directions
from fidsplat.render.shadows import LightPoint, ReceiverPoints, between, light_points, visibility
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.lights import GRIDS, Light, Lighting, PointLight
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import rotation_of_coefficients
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.directions import unit
from fidsplat.util.errors import InputError
from fidsplat.util.response import to_light

FINEST = 8
"""maximum number of parts per module and axis into which boxes are split"""
MOST = 256
"""maximum number of measured points along a side of a square marker"""
SMOOTHEST = 0.5
"""smallest roughness whose reflections harmonics of degree 3 represent (docs/effects.md)"""
MEASURING = "fast,lowpass=none,samples=2"
"""quality of panoramas; their coarse pixels would enlarge small splats with a low-pass filter"""
_DARK = 1e-6
"""radiance below which a panorama is black"""
_CHUNK = 256
_SAME = 0.03
"""maximum angle [rad] between normals of a bent marker for which reflections are computed once"""
_REACH = 3.5
"""standard deviations of a Gaussian beyond which it casts no shadow (opacity below 1 / 255)"""
_WALL = 0.1
"""metres: a light is inside an object if splats are within this distance on all sides"""


def lit_scene(scene: Scene, renderer: Any) -> Scene:
    """The scene with the colours of markers with `light` computed, and without lights."""
    if not any(placed.light for placed in scene.markers):
        return scene
    around = _Surroundings(scene, renderer)
    markers = tuple(_lit(placed, around) if placed.light else placed for placed in scene.markers)
    for number, light in enumerate(scene.lights):
        if isinstance(light, PointLight) and number not in around.arrived and light.power.any():
            around.refuse_inside(number, light)
    return replace(scene, markers=markers, lights=())


class _Surroundings:
    """Splats, background and lights around the lit markers, and their panoramas."""

    def __init__(self, scene: Scene, renderer: Any) -> None:
        self.renderer, self.lights, self.camera = renderer, scene.lights, scene.camera
        unlit = tuple(placed for placed in scene.markers if not placed.light)
        self.scene = Scene(
            scene.clouds,
            markers=unlit,
            background=scene.background,
            fog=scene.fog,
            stores=scene.stores,
            cloud_motions=scene.cloud_motions,
        )
        self.arrived: set[int] = set()
        """indices of the lights that reach a marker"""

    @cached_property
    def resident(self) -> Any:
        return self.renderer.upload(self.scene)

    @cached_property
    def spheres(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (n, 3) and radii (n,) of spheres around the splats."""
        cloud = self.scene.cloud()
        thickness = 0 if cloud.thickness is None else cloud.thickness
        radii = np.hypot(np.linalg.norm(cloud.scales, axis=1), thickness)
        boxes = False if cloud.boxes is None else cloud.boxes
        return cloud.world_means(), np.where(boxes, radii, _REACH * radii)

    def casters(self, light: Light, surface: ReceiverPoints) -> tuple[Any, float]:
        """Black splats on the device that may cast shadows of a light on a surface, or None, and their
        largest distance from the surface, at most 1 km."""
        centres, radii = self.spheres
        rows = np.arange(len(centres))
        if self.scene.motion.is_still:
            rows = rows[between(light, surface, centres, radii)]
        if not len(rows):
            return None, 0.0
        far = np.linalg.norm(centres[rows] - surface.middle, axis=1) + radii[rows]
        black = _rebuilt(self.scene.cloud(), rows, colors=np.zeros((len(rows), 3), np.float32))
        return self.renderer.upload(black), float(min(far.max(), 1e3))

    def panoramas(self, points: np.ndarray, rows: int, near: float, **parts: Any) -> list[Any]:
        """Render panoramas with `alpha` at points (k, 3), in the axes of the world."""
        cameras = []
        for point in points:
            pose = np.eye(4)
            pose[:3, 3] = -point
            cameras.append(Camera.equirectangular(2 * rows, rows, pose, near=near))
        base = self.scene.capture.with_(quality=MEASURING, **parts)
        captures = [base.with_(camera=camera) for camera in cameras]
        return list(self.renderer.render_views(self.resident, captures))

    def refuse_inside(self, number: int, light: PointLight) -> None:
        """Raise InputError for a light that reaches no marker and has splats near it on all sides."""
        position = np.array(light.position)
        (frame,) = self.panoramas(position[None], 16, 1e-4, outputs=("alpha", "depth_median"))
        near = max(light.radius, _WALL)
        blocked = (np.asarray(frame["alpha"]) > 0.5) & (np.asarray(frame["depth_median"]) < near)
        if blocked.mean() > 0.7:
            raise InputError(
                f"lights[{number}] must be outside of surfaces, got the position {tuple(light.position)}, "
                f"which has splats within {near:g} m on all sides; move it"
            )


class _Points(NamedTuple):
    """Points on the splats of a marker at which light is measured: a grid on each box, row by row."""

    local: np.ndarray
    """(m, 3) in the marker's frame"""
    owner: np.ndarray
    """(m,) index of the splat"""
    counts: np.ndarray
    """(n, 2) points along the tangents of each splat"""
    surface: ReceiverPoints

    @property
    def starts(self) -> np.ndarray:
        """Index of each splat's first point, (n,)."""
        return np.cumsum(self.counts.prod(axis=1)) - self.counts.prod(axis=1)


class _Light(NamedTuple):
    irradiance: np.ndarray
    """(m, 3)"""
    field: LightField
    points: list[tuple[LightPoint, np.ndarray]]
    """points of lights, and the visibility (m,) of each"""


def _lit(placed: PlacedMarker, around: _Surroundings) -> PlacedMarker:
    light = Lighting.of(placed.light)
    assert light is not None
    _check_gloss(light, around)
    cloud = placed.marker.cloud
    points = _points(placed, light)
    arriving = _measured(placed, light, points, around)
    shiny = None if light.roughness is None else Gloss(light.roughness, light.reflectance)
    seen = arriving.irradiance / np.pi
    if shiny is not None and light.view == "camera":
        mirrored, factor = _from_camera(points, arriving, shiny, around)
        seen = np.concatenate([seen * factor[:, None], mirrored], 1)
    albedo = light.ink + (light.paper - light.ink) * to_light(_rgb(cloud), "srgb")
    fragments = albedo[points.owner] * seen[:, :3]
    if seen.shape[1] > 3:
        fragments = fragments + seen[:, 3:]
    largest = None if shiny is None or light.view == "camera" else FINEST
    owner, corners, part = _split(points, light.displayed(fragments), light.step, largest)
    means, scales = _placed_parts(cloud, points, owner, corners)
    count = np.bincount(part)
    mean = np.stack([np.bincount(part, values) / count for values in fragments.T], 1)
    colors: dict[str, np.ndarray] = {}
    if shiny is None or light.view == "camera":
        colors["colors"] = light.displayed(mean)
    else:
        shown = [(point, np.bincount(part, one) / count) for point, one in arriving.points]
        sh = _from_anywhere(placed, light, cloud, owner, means, mean, arriving._replace(points=shown))
        # back to the marker's frame, from which the scene rotates harmonics to the world
        colors["sh"] = rotation_of_coefficients(3, placed.pose[:3, :3].T) @ sh
    lit = _rebuilt(cloud, owner, means, scales, **colors)
    return replace(placed, marker=replace(placed.marker, cloud=lit), light=None)


def _check_gloss(light: Lighting, around: _Surroundings) -> None:
    """Raise InputError if harmonics cannot represent the gloss, or there is no camera for it."""
    if light.roughness is None:
        return
    if light.view == "any" and light.roughness < SMOOTHEST:
        raise InputError(
            f"light: roughness must be at least {SMOOTHEST:g} with view='any', as harmonics of degree 3 "
            f"cannot represent sharper reflections, got {light.roughness:g}; use view='camera'"
        )
    if light.view == "camera" and around.camera is None:
        raise InputError("light: the scene must have a camera for view='camera', got none; add a camera")


def _points(placed: PlacedMarker, light: Lighting) -> _Points:
    cloud, pose = placed.marker.cloud, placed.pose
    area = 4 * float((cloud.scales[:, 0] * cloud.scales[:, 1]).sum(dtype=np.float64))
    pitch = max(placed.marker.module / FINEST, np.sqrt(area) / MOST)
    sides = 2 * cloud.scales.astype(np.float64)
    boxes = np.ones(len(cloud), bool) if cloud.boxes is None else cloud.boxes
    boxes = boxes & (cloud.footprint != "gaussian")
    counts = np.where(boxes[:, None], np.maximum(np.rint(sides / pitch), 1), 1).astype(int)
    each = counts.prod(axis=1)
    owner = np.repeat(np.arange(len(cloud)), each)
    index = np.arange(len(owner)) - np.repeat(np.cumsum(each) - each, each)
    row, column = np.divmod(index, counts[owner, 0])
    share = (np.stack([column, row], 1) + 0.5) / counts[owner] * 2 - 1
    offset = (share * cloud.scales[owner])[:, :, None]
    turns = quaternion_to_matrix(cloud.quats)
    local = cloud.world_means()[owner]
    for axis in (0, 1):
        local = local + offset[:, axis] * turns[owner, :, axis]
    # the front of a marker faces its -z
    normals = -turns[owner, :, 2] @ pose[:3, :3].T
    clearance = placed.marker.size / 20 if light.clearance is None else light.clearance
    surface = ReceiverPoints(local @ pose[:3, :3].T + pose[:3, 3], normals, pitch, clearance)
    return _Points(local, owner, counts, surface)


def _measured(placed: PlacedMarker, light: Lighting, points: _Points, around: _Surroundings) -> _Light:
    surface, positions = points.surface, points.local[:, :2]
    field = _field(placed, light, points, around)
    irradiance = np.empty((len(positions), 3))
    for rows in _by_normal(surface.normals):
        irradiance[rows] = field.irradiance(surface.normals[rows[0]], positions[rows])
    shown = []
    for number, one in enumerate(around.lights):
        casters, extent = around.casters(one, surface)
        for point in light_points(one, surface.middle):
            seen = visibility(point, surface, casters, around.scene.motion, extent, around.renderer)
            if seen.any():
                around.arrived.add(number)
                towards, power = point.arriving(surface.points)
                cosine = np.einsum("mc,mc->m", towards, surface.normals)
                irradiance += power * (np.maximum(cosine, 0) * seen)[:, None]
                shown.append((point, seen))
    return _Light(irradiance, field, shown)


def _field(placed: PlacedMarker, light: Lighting, points: _Points, around: _Surroundings) -> LightField:
    """Radiance around the marker from splats and background. Raises InputError if it is black."""
    surface, positions = points.surface, points.local[:, :2]

    def radiance_at(requested: np.ndarray) -> np.ndarray:
        nearest = np.array([np.argmin(((positions - position) ** 2).sum(axis=1)) for position in requested])
        local = points.local[nearest].copy()
        local[:, :2] = requested  # grid points between splats are on the marker's sheet
        at = local @ placed.pose[:3, :3].T + placed.pose[:3, 3]
        at = at + max(surface.clearance, 1e-6) * surface.normals[nearest]
        parts: dict[str, Any] = {"outputs": ("rgb", "alpha")}
        if light.ambient is not None:
            parts["background"] = (0.0, 0.0, 0.0)
        frames = around.panoramas(at, light.rows, 1e-4, **parts)
        found = []
        for frame in frames:
            radiance = to_light(frame["rgb"], light.response).reshape(-1, 3)
            if light.ambient is not None:
                radiance = radiance + (1 - np.asarray(frame["alpha"]).reshape(-1, 1)) * light.ambient
            found.append(radiance)
        return np.stack(found)

    if light.source == "lights":
        if light.ambient is None and not around.lights:
            raise InputError(
                f"marker {placed.label} with light 'lights' must have a light, got none; add [[lights]] or "
                "ambient = [0.5, 0.5, 0.5]"
            )
        return LightField.uniform(light.ambient or (0.0, 0.0, 0.0))
    normal = unit(surface.normals.mean(axis=0))
    levels = tuple(count for count in GRIDS if 3 <= count <= light.panoramas) or (light.panoramas,)
    field = LightField.measured(light.rows, levels, positions, radiance_at, normal, light.step)
    if light.ambient is None and field.radiance.max() < _DARK:
        raise InputError(
            f"the panorama at marker {placed.label}, {placed.marker.spec}, must not be black, got no light; "
            "add splats or a background, set ambient light (ambient = [0.5, 0.5, 0.5]), or use light = "
            "'lights'"
        )
    return field


def _by_normal(normals: np.ndarray, within: float = 1e-4) -> Iterator[np.ndarray]:
    """Groups of row indices whose normals are equal within an angle [rad]."""
    _, group = np.unique(np.rint(normals / within), axis=0, return_inverse=True)
    order = np.argsort(group.ravel(), kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(group.ravel()[order])) + 1)


def _split(
    points: _Points, colors: np.ndarray, step: float, largest: int | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split splats into parts in which the colours (m, 3) of points differ by at most `step`. largest:
    maximum number of points along a side of a part.

    Returns the splat (p,) of each part; its columns and rows [x0, x1) x [y0, y1) on the splat's grid, (p, 4)
    x0, y0, x1, y1; and the part (m,) of each point.
    """
    owner, part = np.arange(len(points.counts)), points.owner.copy()
    corners = np.pad(points.counts, ((0, 0), (2, 0)))
    row, column = np.divmod(np.arange(len(part)) - points.starts[part], points.counts[part, 0])
    place = np.stack([column, row], 1)
    rows = np.arange(len(part))  # points of the parts that may still be split
    while True:
        rows = rows[np.argsort(part[rows], kind="stable")]
        parts, starts = np.unique(part[rows], return_index=True)
        spread = np.maximum.reduceat(colors[rows], starts) - np.minimum.reduceat(colors[rows], starts)
        size = corners[parts, 2:] - corners[parts, :2]
        halved = spread.max(axis=1) > step
        if largest is not None:
            halved |= size.max(axis=1) > largest
        halved &= size.max(axis=1) > 1
        if not halved.any():
            return owner, corners, part
        parts, axis = parts[halved], (size[:, 1] > size[:, 0])[halved].astype(int)
        middle = (corners[parts, axis] + corners[parts, axis + 2]) // 2
        second = corners[parts]
        corners[parts, axis + 2] = second[np.arange(len(parts)), axis] = middle
        number = np.full(len(owner), -1)
        number[parts] = np.arange(len(parts))
        rows = rows[number[part[rows]] >= 0]
        own = number[part[rows]]
        beyond = place[rows, axis[own]] >= middle[own]
        part[rows[beyond]] = len(owner) + own[beyond]
        owner, corners = np.concatenate([owner, owner[parts]]), np.concatenate([corners, second])


def _placed_parts(
    cloud: SplatCloud, points: _Points, owner: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (p, 3) in the marker's frame, and scales (p, 2), of parts."""
    shares = corners.reshape(-1, 2, 2) / points.counts[owner][:, None]
    offset = (shares.sum(axis=1) - 1) * cloud.scales[owner]
    scales = (shares[:, 1] - shares[:, 0]) * cloud.scales[owner]
    turns = quaternion_to_matrix(cloud.quats)[owner]
    means = cloud.means[owner] + offset[:, :1] * turns[:, :, 0] + offset[:, 1:] * turns[:, :, 1]
    return means, scales


def _from_camera(
    points: _Points, arriving: _Light, shiny: Gloss, around: _Surroundings
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (m, 3) that points reflect to the scene's camera, and factor (m,) of their matte colour."""
    surface = points.surface
    camera = around.camera
    assert camera is not None
    if isinstance(camera.lens, Orthographic):
        viewers = np.broadcast_to(-camera.world_to_camera[2, :3], surface.points.shape)
    else:
        viewers = unit(camera.position - surface.points)
    found = _highlights(surface.points, surface.normals, viewers[:, None], shiny, arriving.points)[:, 0]
    for start in range(0, len(viewers) if arriving.field.radiance.any() else 0, _CHUNK):
        rows = slice(start, start + _CHUNK)
        directions, weights = lobe(viewers[rows, None], surface.normals[rows], shiny)
        radiance = arriving.field.arriving(directions[:, 0], points.local[rows, :2])
        found[rows] += np.einsum("nk,nkc->nc", weights[:, 0], radiance)
    cosine = np.einsum("mc,mc->m", viewers, surface.normals)
    return found, 1 - fresnel(cosine, shiny.reflectance)


def _highlights(
    positions: np.ndarray,
    normals: np.ndarray,
    viewers: np.ndarray,
    shiny: Gloss,
    shown: list[tuple[LightPoint, np.ndarray]],
) -> np.ndarray:
    """Reflections (n, v, 3) of lights at positions (n, 3) towards viewers (n, v, 3)."""
    found = np.zeros(viewers.shape)
    cosine = np.einsum("nvc,nc->nv", viewers, normals)
    for point, seen in shown:
        towards, power = point.arriving(positions)
        reflected = gloss(cosine, viewers, towards, normals, shiny)
        found += reflected[..., None] * (power * seen[:, None])[:, None]
    return found


def _from_anywhere(
    placed: PlacedMarker,
    light: Lighting,
    cloud: SplatCloud,
    owner: np.ndarray,
    means: np.ndarray,
    diffuse: np.ndarray,
    arriving: _Light,
) -> np.ndarray:
    """Spherical harmonics (p, 16, 3), in the axes of the world, of the colours of parts."""
    assert light.roughness is not None
    shiny, rotation = Gloss(light.roughness, light.reflectance), placed.pose[:3, :3]
    positions = (means + cloud.origin) @ rotation.T + placed.pose[:3, 3]
    normals = -quaternion_to_matrix(cloud.quats)[owner, :, 2] @ rotation.T
    sh = np.empty((len(owner), 16, 3))
    for same in _by_normal(normals, _SAME):
        normal = normals[same[0]]
        views = view_directions(normal)
        directions, weights = lobe(views[None], normal[None], shiny)
        factor = 1 - fresnel(views @ normal, shiny.reflectance)
        mirrored = arriving.field.reflected(directions[0], weights[0])
        for start in range(0, len(same), _CHUNK):
            rows = same[start : start + _CHUNK]
            shown = [(point, one[rows]) for point, one in arriving.points]
            viewers = np.broadcast_to(views, (len(rows), *views.shape))
            total = _highlights(positions[rows], normals[rows], viewers, shiny, shown)
            total += factor[:, None] * diffuse[rows, None]
            total += arriving.field.interpolated(mirrored, means[rows, :2])
            sh[rows] = fit_harmonics(views, light.displayed(total))
    return sh


def _rgb(cloud: SplatCloud) -> np.ndarray:
    """Colours (n, 3) of a marker's splats."""
    colors = cloud.plain_colors
    if colors is None:
        raise InputError(
            f"a lit marker must have plain colours, got harmonics of degree {cloud.sh_degree}; leave "
            "out its light"
        )
    return colors


def _rebuilt(
    cloud: SplatCloud,
    owner: np.ndarray | None = None,
    means: np.ndarray | None = None,
    scales: np.ndarray | None = None,
    **colors: np.ndarray,
) -> SplatCloud:
    """Cloud of parts of splats, or of all splats, with other colours. owner: (p,) splat of each part."""
    rows = np.arange(len(cloud)) if owner is None else owner
    scales = cloud.scales[rows] if scales is None else scales
    if cloud.thickness is not None:
        scales = np.column_stack([scales, cloud.thickness[rows]])
    built = SplatCloud(
        cloud.means[rows] if means is None else means.astype(np.float32),
        cloud.quats[rows],
        scales,
        cloud.opacities[rows],
        labels=cloud.labels[rows],
        origin=cloud.origin,
        **colors,
    )
    if cloud.boxes is not None:
        built = built.with_boxes(cloud.boxes[rows])
    groups = cloud.coplanar_groups
    return built if groups is None else built.with_coplanar_groups(groups[rows])
