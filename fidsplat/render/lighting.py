"""Lighting of markers: colours of their splats from the light of the scene. Panoramas measure the radiance
around a marker. Shadow maps measure the visibility of `Scene.lights`. Box splats (the hard-edged rectangles
of which markers consist) are split where the light changes.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.lenses import Orthographic
from fidsplat.capture.environment import Panorama
from fidsplat.render.irradiance import LightField, normal_groups
from fidsplat.render.reflection import GlossyBrdf, fit_harmonics, fresnel, view_directions
from fidsplat.render.shadows import LightPoint, ReceiverPoints, light_points, shadow_casters, visibility
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.lights import PANORAMAS_PER_SIDE, Light, Lighting, PointLight
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import rotation_of_coefficients
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.directions import unit
from fidsplat.util.errors import InputError
from fidsplat.util.response import linear_light, to_colors

POINTS_PER_MODULE = 8
"""maximum number of sample points per module along each axis; a part of a box splat has at least one"""
MAX_POINTS = 256
"""maximum number of sample points along a side of a square marker"""
MIN_HARMONIC_ROUGHNESS = 0.5
"""minimum roughness for which spherical harmonics of degree 3 represent reflections (docs/effects.md)"""
PANORAMA_QUALITY = "fast,lowpass=pixel,samples=2"
"""quality of panoramas; the low-pass filter conserves the energy of splats smaller than a panorama pixel"""
_DARK = 1e-6
"""radiance below which a panorama is black"""
_POINTS_AT_ONCE = 256
"""points whose reflections are computed at once, which bounds memory"""
_NORMAL_STEP = 0.03
"""step to which normals of a bent marker are rounded; equal ones share reflections"""
_SHADOW_SIGMAS = 3.5
"""standard deviations of a Gaussian beyond which it casts no shadow (opacity below 1 / 255)"""
_INSIDE_RADIUS = 0.1
"""metres: a light is inside an object if splats are within this distance in most directions"""


def lit_scene(scene: Scene, renderer: Any) -> Scene:
    """Compute the colours of the markers that have `light`. Returns the scene with them, without lights."""
    if not any(placed.light for placed in scene.markers):
        return scene
    environment = _Environment(scene, renderer)
    markers = tuple(
        _shaded_marker(placed, environment) if placed.light else placed for placed in scene.markers
    )
    for number, light in enumerate(scene.lights):
        if isinstance(light, PointLight) and number not in environment.reaching_lights and light.power.any():
            environment.refuse_inside(number, light)
            warnings.warn(
                f"lights[{number}] must reach a marker with light, got the position {light.position}, which "
                "is behind the markers, occluded or directed away; move it",
                stacklevel=4,
            )
    return replace(scene, markers=markers, lights=())


class _Environment:
    """Splats, background and lights around the lit markers; renders panoramas of them."""

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
        self.reaching_lights: set[int] = set()
        """indices of the lights that reach a marker"""
        self._backgrounds: dict[tuple[int, str | float], Any] = {}

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
        return cloud.world_means(), np.where(boxes, radii, _SHADOW_SIGMAS * radii)

    def casters(self, light: Light, surface: ReceiverPoints) -> tuple[Any, float]:
        """Upload the splats that may shadow a surface from a light, in black. Returns them (None if there
        are none) and their largest distance [m] from the middle of the surface, at most 1 km."""
        centers, radii = self.spheres
        casters = np.arange(len(centers))
        if self.scene.motion.is_still:
            casters = shadow_casters(light, surface, centers, radii)
        if not len(casters):
            return None, 0.0
        distances = np.linalg.norm(centers[casters] - surface.middle, axis=1) + radii[casters]
        black = _rebuilt(self.scene.cloud(), casters, colors=np.zeros((len(casters), 3), np.float32))
        return self.renderer.upload(black), float(min(distances.max(), 1e3))

    def background(self, height: int, response: str | float) -> Any:
        """The background of panoramas of 2 height x height pixels, computed once for all markers."""
        key = height, response
        if key not in self._backgrounds:
            self._backgrounds[key] = _averaged_background(self.scene.background, height, response)
        return self._backgrounds[key]

    def panoramas(self, positions: np.ndarray, height: int, near: float, **fields: Any) -> list[Any]:
        """Render panoramas of 2 height x height pixels at positions (k, 3), in the axes of the world.

        fields: fields of `Capture` that replace the scene's, such as outputs.
        """
        cameras = []
        for position in positions:
            pose = np.eye(4)
            pose[:3, 3] = -position
            cameras.append(Camera.equirectangular(2 * height, height, pose, near=near))
        base = self.scene.capture.with_(quality=PANORAMA_QUALITY, **fields)
        captures = [base.with_(camera=camera) for camera in cameras]
        return list(self.renderer.render_views(self.resident, captures))

    def refuse_inside(self, number: int, light: PointLight) -> None:
        """Raise InputError for a light that reaches no marker and has splats near it in most
        directions."""
        position = np.array(light.position)
        (frame,) = self.panoramas(position[None], 16, 1e-4, outputs=("alpha", "depth_median"))
        near = max(light.radius, _INSIDE_RADIUS)
        blocked = (np.asarray(frame["alpha"]) > 0.5) & (np.asarray(frame["depth_median"]) < near)
        if blocked.mean() > 0.7:
            raise InputError(
                f"lights[{number}] must be outside of surfaces, got the position {tuple(light.position)}, "
                f"which has splats within {near:g} m in most directions; move it"
            )


class _SamplePoints(NamedTuple):
    """Sample points on the splats of a marker, at which light is measured: a grid on each box splat, row by
    row, and the centre of each Gaussian."""

    local: np.ndarray
    """(m, 3) in the marker's frame"""
    splat: np.ndarray
    """(m,) index of each point's splat"""
    grid_sizes: np.ndarray
    """(n, 2) number of points along the tangents of each splat"""
    surface: ReceiverPoints

    @property
    def starts(self) -> np.ndarray:
        """Index of each splat's first point, (n,)."""
        return np.cumsum(self.grid_sizes.prod(axis=1)) - self.grid_sizes.prod(axis=1)


class _IncomingLight(NamedTuple):
    """Light that arrives at the sample points of a marker."""

    irradiance: np.ndarray
    """(m, 3) at each point"""
    field: LightField
    lights: list[tuple[LightPoint, np.ndarray]]
    """points of lights, with the visibility (m,) of each from the sample points"""


def _shaded_marker(placed: PlacedMarker, environment: _Environment) -> PlacedMarker:
    """The marker with the colours computed for its light; its field `light` is None.

    Glossy markers: with view='camera' their colours hold for the scene's camera only, with 'any' they are
    spherical harmonics.
    """
    lighting = Lighting.of(placed.light)
    assert lighting is not None
    _check_roughness(placed, lighting, environment)
    cloud = placed.marker.cloud
    samples = _sample_points(placed, lighting)
    incoming = _incoming_light(placed, lighting, samples, environment)
    brdf = None if lighting.roughness is None else GlossyBrdf(lighting.roughness, lighting.reflectance)
    diffuse, specular = incoming.irradiance / np.pi, np.zeros(3)
    if brdf is not None and lighting.view == "camera":
        specular, transmitted = _reflection_to_camera(samples, incoming, brdf, environment)
        diffuse = diffuse * transmitted[:, None]
    albedo = lighting.ink + (lighting.paper - lighting.ink) * linear_light(_rgb(cloud), "srgb")
    radiance = albedo[samples.splat] * diffuse + specular
    # parts with harmonics show moving highlights, so they are at most 8 points wide: a module, or 1/32 of a
    # large marker
    max_points = None if brdf is None or lighting.view == "camera" else POINTS_PER_MODULE
    splat, extents, part = _split(samples, radiance, lighting.step, max_points)
    means, scales = _part_geometry(cloud, samples, splat, extents)
    count = np.bincount(part)
    mean = np.stack([np.bincount(part, values) / count for values in radiance.T], 1)
    colors: dict[str, np.ndarray] = {}
    if brdf is None or lighting.view == "camera":
        colors["colors"] = lighting.encode(mean)
    else:
        lights = [(source, np.bincount(part, visible) / count) for source, visible in incoming.lights]
        incoming = incoming._replace(lights=lights)
        sh = _harmonics_of_parts(placed, lighting, cloud, splat, means, mean, incoming)
        # back to the marker's frame, from which the scene rotates harmonics to the world
        colors["sh"] = rotation_of_coefficients(3, placed.pose[:3, :3].T) @ sh
    lit = _rebuilt(cloud, splat, means, scales, **colors)
    return replace(placed, marker=replace(placed.marker, cloud=lit), light=None)


def _averaged_background(background: Any, height: int, response: str | float) -> Any:
    """A background whose panorama is averaged in linear light to 2 height x height pixels. Without this, a
    small bright source, such as the sun, would be missed or counted several times."""
    if not isinstance(background, Panorama) or background.image.shape[0] <= height:
        return background
    light = linear_light(background.image, response).astype(np.float64)
    full_height = len(light)
    solid_angle = np.sin((np.arange(full_height) + 0.5) / full_height * np.pi)[:, None, None]
    weighted = np.concatenate([light * solid_angle, np.broadcast_to(solid_angle, light.shape)], 2)
    for axis, count in enumerate((height, 2 * height)):
        size = weighted.shape[axis]
        starts = np.unique(np.arange(count) * size // count)
        weighted = np.add.reduceat(weighted, starts, axis)
    return Panorama(to_colors(weighted[..., :3] / weighted[..., 3:], response))


def _check_roughness(placed: PlacedMarker, lighting: Lighting, environment: _Environment) -> None:
    """Raise InputError if spherical harmonics cannot represent the reflection, or it requires a camera."""
    if lighting.roughness is None:
        return
    if lighting.view == "any" and lighting.roughness < MIN_HARMONIC_ROUGHNESS:
        raise InputError(
            f"roughness of the light of marker {placed.label}, {placed.marker.spec}, must be at least "
            f"{MIN_HARMONIC_ROUGHNESS:g} with view='any', as harmonics of degree 3 cannot represent sharper "
            f"reflections, got {lighting.roughness:g}; use view='camera'"
        )
    if lighting.view == "camera" and environment.camera is None:
        raise InputError(
            "the scene must have a camera for markers whose light has view='camera', got none; add a camera"
        )


def _sample_points(placed: PlacedMarker, lighting: Lighting) -> _SamplePoints:
    """Sample points of a marker: a grid on each box splat, the centre of each Gaussian."""
    cloud, pose = placed.marker.cloud, placed.pose
    area = 4 * float((cloud.scales[:, 0] * cloud.scales[:, 1]).sum(dtype=np.float64))
    pitch = max(placed.marker.module / POINTS_PER_MODULE, np.sqrt(area) / MAX_POINTS)
    sides = 2 * cloud.scales.astype(np.float64)
    is_box = np.ones(len(cloud), bool) if cloud.boxes is None else cloud.boxes
    is_box = is_box & (cloud.footprint != "gaussian")
    grid_sizes = np.where(is_box[:, None], np.maximum(np.rint(sides / pitch), 1), 1).astype(int)
    per_splat = grid_sizes.prod(axis=1)
    splat = np.repeat(np.arange(len(cloud)), per_splat)
    index = np.arange(len(splat)) - np.repeat(np.cumsum(per_splat) - per_splat, per_splat)
    row, column = np.divmod(index, grid_sizes[splat, 0])
    coordinates = (np.stack([column, row], 1) + 0.5) / grid_sizes[splat] * 2 - 1
    offset = (coordinates * cloud.scales[splat])[:, :, None]
    rotations = quaternion_to_matrix(cloud.quats)
    local = cloud.world_means()[splat]
    for axis in (0, 1):
        local = local + offset[:, axis] * rotations[splat, :, axis]
    # the front of a marker faces its -z
    normals = -rotations[splat, :, 2] @ pose[:3, :3].T
    clearance = placed.marker.size / 20 if lighting.clearance is None else lighting.clearance
    surface = ReceiverPoints(local @ pose[:3, :3].T + pose[:3, 3], normals, pitch, clearance)
    return _SamplePoints(local, splat, grid_sizes, surface)


def _incoming_light(
    placed: PlacedMarker, lighting: Lighting, samples: _SamplePoints, environment: _Environment
) -> _IncomingLight:
    """Measure the light at the sample points: panoramas for the field, shadow maps for the lights."""
    surface, positions = samples.surface, samples.local[:, :2]
    field = _field(placed, lighting, samples, environment)
    irradiance = field.irradiance(surface.normals, positions)
    lights = []
    for number, light in enumerate(environment.lights):
        casters, extent = environment.casters(light, surface)
        for light_point in light_points(light, surface.middle):
            motion, renderer = environment.scene.motion, environment.renderer
            visible = visibility(light_point, surface, casters, motion, extent, renderer)
            if visible.any():
                directions, unshadowed = light_point.irradiance(surface.positions)
                cosine = np.einsum("mc,mc->m", directions, surface.normals)
                arriving = unshadowed * (np.maximum(cosine, 0) * visible)[:, None]
                if arriving.any():
                    environment.reaching_lights.add(number)
                irradiance += arriving
                lights.append((light_point, visible))
    return _IncomingLight(irradiance, field, lights)


def _field(
    placed: PlacedMarker, lighting: Lighting, samples: _SamplePoints, environment: _Environment
) -> LightField:
    """Radiance around the marker from splats and background. Raises InputError if it is black."""
    surface, positions = samples.surface, samples.local[:, :2]
    capture, height = environment.scene.capture, lighting.rows

    def radiance_at(grid_positions: np.ndarray) -> np.ndarray:
        nearest = np.array([np.argmin(((positions - grid) ** 2).sum(axis=1)) for grid in grid_positions])
        local_positions = samples.local[nearest].copy()
        local_positions[:, :2] = grid_positions  # a grid point between splats has the z of the nearest one
        panorama_positions = local_positions @ placed.pose[:3, :3].T + placed.pose[:3, 3]
        panorama_positions = panorama_positions + max(surface.clearance, 1e-6) * surface.normals[nearest]
        black = (0.0, 0.0, 0.0)
        background = environment.background(height, lighting.response) if lighting.ambient is None else black
        fields = {"outputs": ("rgb", "alpha"), "background": background}
        frames = environment.panoramas(panorama_positions, height, 1e-4, **fields)
        panoramas = []
        for frame in frames:
            colors, empty = frame["rgb"].reshape(-1, 3), 1 - frame["alpha"].reshape(-1, 1)
            if lighting.ambient is not None and capture.has_fog:  # `ambient` replaces the fog's colour
                colors = np.maximum(colors - empty * np.array(capture.rendered_background), 0)
            radiance = linear_light(colors, lighting.response)
            panoramas.append(radiance if lighting.ambient is None else radiance + empty * lighting.ambient)
        return np.stack(panoramas)

    if lighting.source == "lights":
        if lighting.ambient is None and not environment.lights:
            raise InputError(
                f"the scene must have lights for marker {placed.label} (light = 'lights'), got none; add "
                "[[lights]] or ambient = [0.5, 0.5, 0.5]"
            )
        return LightField.uniform(lighting.ambient or (0.0, 0.0, 0.0))
    normal = unit(surface.normals.mean(axis=0))
    levels = tuple(count for count in PANORAMAS_PER_SIDE if 3 <= count <= lighting.panoramas) or (
        lighting.panoramas,
    )
    field = LightField.measured(lighting.rows, levels, positions, radiance_at, normal, lighting.step)
    if lighting.ambient is None and field.radiance.max() < _DARK:
        raise InputError(
            f"the panorama at marker {placed.label}, {placed.marker.spec}, must not be black, got no light; "
            "add splats or a background, set ambient light (ambient = [0.5, 0.5, 0.5]), or use light = "
            "'lights'"
        )
    return field


def _split(
    samples: _SamplePoints, radiance: np.ndarray, tolerance: float, max_points: int | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split box splats into parts until the radiance (m, 3) of each part's points differs from its mean by at
    most `tolerance` times the mean of all channels. max_points: maximum number of points along a side of a
    part; None: no limit.

    Returns:
        splat (p,): index of the splat of each part.
        extents (p, 4): x0, y0, x1, y1 of each part on the splat's grid, ends exclusive.
        part (m,): index of the part of each point.
    """
    splat, part = np.arange(len(samples.grid_sizes)), samples.splat.copy()
    extents = np.pad(samples.grid_sizes, ((0, 0), (2, 0)))
    row, column = np.divmod(np.arange(len(part)) - samples.starts[part], samples.grid_sizes[part, 0])
    cell = np.stack([column, row], 1)
    active = np.arange(len(part))  # points of the parts that may still be split
    while True:
        active = active[np.argsort(part[active], kind="stable")]
        parts, starts, counts = np.unique(part[active], return_index=True, return_counts=True)
        mean = np.add.reduceat(radiance[active], starts) / counts[:, None]
        high, low = (reduce.reduceat(radiance[active], starts) for reduce in (np.maximum, np.minimum))
        size = extents[parts, 2:] - extents[parts, :2]
        too_large = np.maximum(high - mean, mean - low).max(axis=1) > tolerance * mean.mean(axis=1)
        if max_points is not None:
            too_large |= size.max(axis=1) > max_points
        too_large &= size.max(axis=1) > 1
        if not too_large.any():
            return splat, extents, part
        parts, axis = parts[too_large], (size[:, 1] > size[:, 0])[too_large].astype(int)
        middle = (extents[parts, axis] + extents[parts, axis + 2]) // 2
        upper_half = extents[parts]
        extents[parts, axis + 2] = upper_half[np.arange(len(parts)), axis] = middle
        index_of = np.full(len(splat), -1)
        index_of[parts] = np.arange(len(parts))
        active = active[index_of[part[active]] >= 0]
        index = index_of[part[active]]
        in_upper = cell[active, axis[index]] >= middle[index]
        part[active[in_upper]] = len(splat) + index[in_upper]
        splat, extents = np.concatenate([splat, splat[parts]]), np.concatenate([extents, upper_half])


def _part_geometry(
    cloud: SplatCloud, samples: _SamplePoints, splat: np.ndarray, extents: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (p, 3) in the marker's frame and scales (p, 2) of the parts of box splats."""
    edges = extents.reshape(-1, 2, 2) / samples.grid_sizes[splat][:, None]
    offset = (edges.sum(axis=1) - 1) * cloud.scales[splat]
    scales = (edges[:, 1] - edges[:, 0]) * cloud.scales[splat]
    rotations = quaternion_to_matrix(cloud.quats)[splat]
    means = cloud.means[splat] + offset[:, :1] * rotations[:, :, 0] + offset[:, 1:] * rotations[:, :, 1]
    return means, scales


def _reflection_to_camera(
    samples: _SamplePoints, incoming: _IncomingLight, brdf: GlossyBrdf, environment: _Environment
) -> tuple[np.ndarray, np.ndarray]:
    """Specular radiance (m, 3) from points to the scene's camera, and factor (m,) of their diffuse colour."""
    surface = samples.surface
    camera = environment.camera
    assert camera is not None
    if isinstance(camera.lens, Orthographic):
        viewers = np.broadcast_to(-camera.world_to_camera[2, :3], surface.positions.shape)
    else:
        viewers = unit(camera.position - surface.positions)
    reflected = _highlights(surface.positions, surface.normals, viewers[:, None], brdf, incoming.lights)[:, 0]
    for start in range(0, len(viewers) if incoming.field.radiance.any() else 0, _POINTS_AT_ONCE):
        batch = slice(start, start + _POINTS_AT_ONCE)
        directions, weights = brdf.sample(viewers[batch, None], surface.normals[batch])
        radiance = incoming.field.incoming_radiance(directions[:, 0], samples.local[batch, :2])
        reflected[batch] += np.einsum("nk,nkc->nc", weights[:, 0], radiance)
    cosine = np.einsum("mc,mc->m", viewers, surface.normals)
    return reflected, 1 - fresnel(cosine, brdf.reflectance)


def _highlights(
    positions: np.ndarray,
    normals: np.ndarray,
    viewers: np.ndarray,
    brdf: GlossyBrdf,
    lights: list[tuple[LightPoint, np.ndarray]],
) -> np.ndarray:
    """Specular radiance (n, v, 3) of lights from positions (n, 3) in the directions (n, v, 3) of viewers."""
    total = np.zeros(viewers.shape)
    cosine = np.einsum("nvc,nc->nv", viewers, normals)
    for light_point, visible in lights:
        directions, irradiance = light_point.irradiance(positions)
        reflected = brdf.reflected(cosine, viewers, directions, normals)
        total += reflected[..., None] * (irradiance * visible[:, None])[:, None]
    return total


def _harmonics_of_parts(
    placed: PlacedMarker,
    lighting: Lighting,
    cloud: SplatCloud,
    splat: np.ndarray,
    means: np.ndarray,
    diffuse: np.ndarray,
    incoming: _IncomingLight,
) -> np.ndarray:
    """Spherical harmonics (p, 16, 3), in the axes of the world, of the glossy colours of parts."""
    assert lighting.roughness is not None
    brdf, rotation = GlossyBrdf(lighting.roughness, lighting.reflectance), placed.pose[:3, :3]
    positions = (means + cloud.origin) @ rotation.T + placed.pose[:3, 3]
    normals = -quaternion_to_matrix(cloud.quats)[splat, :, 2] @ rotation.T
    sh = np.empty((len(splat), 16, 3))
    first, group = normal_groups(normals, _NORMAL_STEP)
    for number, normal in enumerate(normals[first]):
        members = np.flatnonzero(group == number)
        views = view_directions(normal)
        directions, weights = brdf.sample(views[None], normal[None])
        transmitted = 1 - fresnel(views @ normal, brdf.reflectance)
        reflected = incoming.field.reflected(directions[0], weights[0])
        for start in range(0, len(members), _POINTS_AT_ONCE):
            batch = members[start : start + _POINTS_AT_ONCE]
            lights = [(light_point, visible[batch]) for light_point, visible in incoming.lights]
            viewers = np.broadcast_to(views, (len(batch), *views.shape))
            total = _highlights(positions[batch], normals[batch], viewers, brdf, lights)
            total += transmitted[:, None] * diffuse[batch, None]
            total += incoming.field.interpolated(reflected, means[batch, :2])
            sh[batch] = fit_harmonics(views, lighting.encode(total))
    return sh


def _rgb(cloud: SplatCloud) -> np.ndarray:
    """Colours (n, 3) of a marker's splats."""
    colors = cloud.plain_colors
    if colors is None:
        raise InputError(
            f"a marker with light must have plain colours, got spherical harmonics of degree "
            f"{cloud.sh_degree}; leave out its light"
        )
    return colors


def _rebuilt(
    cloud: SplatCloud,
    splat: np.ndarray | None = None,
    means: np.ndarray | None = None,
    scales: np.ndarray | None = None,
    **colors: np.ndarray,
) -> SplatCloud:
    """Copy of a cloud with new colours. splat: (p,) index of the copied splat of each row; None: all."""
    rows = np.arange(len(cloud)) if splat is None else splat
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
