"""View: the uniforms of a frame, from a camera, a quality and a background."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fidsplat.cameras import Camera, Orthographic
from fidsplat.cameras.lenses import Lens
from fidsplat.cameras.raster import RayRaster, raster_of
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import ExternalDepth, Gradient, Panorama
from fidsplat.capture.sensor import Sensor
from fidsplat.util.errors import InputError

FAR_EYE = 1e9
"""metres: distance of the eye from which view-dependent colours of a parallel projection are evaluated"""
NO_CAMERA = "camera must be given, got none; pass camera=fs.Camera(...), or give the scene a [camera] table"
MAX_GRID = 32767
"""largest side of the sample grid: kernels store rows and columns of samples in 16 bits"""
_NO_SENSOR = Sensor()


def rotated(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Multiply each matrix (..., 3, 3) with its vector (..., 3), without -0 and, unlike `@`, with the same
    rounding on every processor."""
    return (matrices * vectors[..., None, :]).sum(axis=-1) + 0.0


def moved_pose(
    rotation: np.ndarray, translation: np.ndarray, motion: np.ndarray, origin: np.ndarray, parallel: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation, translation and eye of `View` for splats that are moved by rigid motions (..., 4, 4) in world
    coordinates. rotation (..., 3, 3), translation (..., 3): of the view without motions."""
    group_rotation, group_translation = motion[..., :3, :3], motion[..., :3, 3]
    moved_rotation = rotation @ group_rotation
    origins = np.broadcast_to(origin, group_translation.shape)
    shift = rotated(group_rotation, origins) + group_translation - origin
    moved = translation + rotated(rotation, shift)
    eye = rotated(-np.swapaxes(moved_rotation, -1, -2), moved)
    return moved_rotation, moved, eye - FAR_EYE * moved_rotation[..., 2, :] if parallel else eye


@dataclass(frozen=True)
class View:
    """The uniforms of a frame, in float64. The sample grid is the image with `samples` x `samples` samples
    per pixel."""

    width: int
    height: int
    samples: int
    """samples per pixel along each axis"""
    focal_x: float
    """samples per unit of x / z (pinhole), per radian (fisheye, panorama) or per metre (parallel rays)"""
    focal_y: float
    center_x: float
    """samples: principal point"""
    center_y: float
    rotation: np.ndarray
    """(3, 3) world to camera"""
    translation: np.ndarray
    """(3,) metres: the cloud's origin in the camera frame"""
    eye: np.ndarray
    """(3,) metres: camera centre minus the cloud's origin; far behind the camera for parallel rays"""
    near: float
    """metres: minimum depth of a fragment"""
    far: float
    """metres: splats that are completely deeper are culled"""
    log_alpha_cutoff: float
    """natural logarithm of the alpha cut-off, rounded to float32"""
    opacity_ceiling: float
    """maximum alpha of a fragment"""
    transmittance_stop: float
    """transmittance at which blending terminates early"""
    background: tuple[float, float, float]
    """background colour; with fog, the fog's colour"""
    first_hit_transmittance: float
    """threshold of `depth_first`: the first fragment behind which the transmittance is at most this value is
    the first hit of a pixel"""
    sensor: Sensor = _NO_SENSOR
    fog_density: float = 0.0
    """fog density per metre"""
    environment_map: Gradient | Panorama | None = None
    """background that depends on the ray's direction"""
    external_depth: ExternalDepth | None = None
    """external depth image: an opaque surface among the splats; in a batch possibly one for each view"""
    raster: RayRaster | None = None
    """rays of the samples for a camera with a lens; None for a pinhole and for parallel rays"""
    along_ray: bool = False
    """whether depths (and near, far, sort keys) are distances from the camera; else z"""
    ewa_clamp: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """limits of -x, x, -y, y at z = 1, to which EWA clamps the centre of a splat before it linearises the
    projection"""
    parallel: bool = False
    """whether all rays are parallel to z; focal_x and focal_y are samples per metre then"""
    groups: tuple[tuple[int, View], ...] = ()
    """(label, view of its splats), for moving groups of splats"""
    sub_frames: tuple[SubFrame, ...] = ()
    """sub-frames of an exposure; empty for a single pose"""
    sample_rows: tuple[int, int] | None = None
    """rows of samples [first, end) to render, bit-identical to those of the complete frame; None: all"""
    device_record: Any = None
    """uniforms of the projection in device memory (`opencl.buffers.DeviceRecord`), used instead of those of
    this view; None: there are none"""
    kernel_arguments: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    """cache of the backends: the view's kernel arguments, by the kernels that receive them"""

    @property
    def lens(self) -> Lens | None:
        """Lens of the camera; None for a pinhole."""
        if self.raster is not None:
            return self.raster.lens
        return Orthographic() if self.parallel else None

    @property
    def row_rotations(self) -> np.ndarray:
        """(h, 3, 3) rotation world to camera for the normals of each row of pixels."""
        rotations = np.tile(self.rotation, (self.height // self.samples, 1, 1))
        for sub_frame in self.sub_frames:
            if sub_frame.middle:
                top = sub_frame.top // self.samples
                rotations[top : top + sub_frame.view.height // self.samples] = sub_frame.view.rotation
        return rotations

    def rows(self, top: int, end: int) -> View:
        """The view restricted to rows of samples [top, end)."""
        if (top, end) == (0, self.height):
            return self
        return replace(
            self,
            height=end - top,
            center_y=self.center_y - top,
            raster=None if self.raster is None else self.raster.rows(top, end),
            groups=tuple((label, view.rows(top, end)) for label, view in self.groups),
        )

    def uniforms_of(self, name: str) -> tuple[Any, ...]:
        """Uniforms of an effect, by the name of their group."""
        environment = self.environment_map
        match name:
            case "ray" if self.along_ray or self.parallel:
                # depths are distances along the ray already
                return math.inf, math.inf, 0.0, 0.0
            case "ray":
                return self.focal_x, self.focal_y, self.center_x, self.center_y
            case "gradient" if isinstance(environment, Gradient):
                up = np.array(environment.up) / np.linalg.norm(environment.up)
                return (*environment.top, *environment.bottom, *up.tolist())
            case "panorama_size":
                height, width = self.array("panorama").shape[:2]
                return np.int32(width), np.int32(height)
            case "vignette_center":
                half_diagonal = math.hypot(self.width, self.height) / 2 / self.samples
                return self.center_x / self.samples, self.center_y / self.samples, 1 / half_diagonal
            case "first_hit_transmittance" | "fog_density":
                return (getattr(self, name),)
            case _:
                return self.sensor.uniforms_of(name)

    def array(self, name: str) -> np.ndarray:
        """An array of an effect by its name: int32 for labels, else float32."""
        if self.external_depth is not None and name.startswith("external_"):
            return getattr(self.external_depth, name.removeprefix("external_"))
        match name:
            case "row_rotations":
                return self.row_rotations.astype(np.float32)
            case "panorama" if isinstance(self.environment_map, Panorama):
                return self.environment_map.image
            case "response":
                return np.asarray(self.sensor.response, np.float32)
            case _:
                raise KeyError(name)

    @classmethod
    def of(cls, capture: Capture, origin: np.ndarray, camera: Camera | None = None) -> View:
        """The view of a capture's camera, or of `camera` instead, for a cloud with its means relative to
        `origin` (3,). Motions are ignored. Raises InputError if there is no camera, or the sample grid is too
        large."""
        camera = camera or capture.camera
        if camera is None:
            raise InputError(NO_CAMERA)
        quality, background = capture.quality, capture.rendered_background
        n = quality.samples
        if max(camera.width, camera.height) * n > MAX_GRID:
            raise InputError(
                f"a frame must have at most {MAX_GRID} samples along a side, got {camera.width} x "
                f"{camera.height} pixels with {n} x {n} samples each; use fewer samples or a smaller image"
            )
        external = capture.external_depth
        if external is not None and external.depth.shape != (camera.height, camera.width):
            raise InputError(
                f"external_depth must have the camera's {camera.width} x {camera.height} pixels, got "
                f"{' x '.join(map(str, reversed(external.depth.shape)))}; render it with this camera"
            )
        plain = isinstance(background, tuple)
        rotation = camera.world_to_camera[:3, :3]
        # subtract before the rotation: rotating large coordinates loses precision (devlog/hard-cases.md, B5)
        eye = camera.position - np.asarray(origin, dtype=np.float64)
        lens, grid = camera.lens, (camera.width * n, camera.height * n)
        intrinsics = camera.fx * n, camera.fy * n, camera.cx * n, camera.cy * n
        parallel = isinstance(lens, Orthographic)
        fx, fy, cx, cy = intrinsics
        # as in 3DGS and gsplat: 0.3 times the half width, and half height, outside the image
        beyond_x, beyond_y = 0.15 * grid[0] / fx, 0.15 * grid[1] / fy
        ewa_clamp = (
            *(cx / fx + beyond_x, (grid[0] - cx) / fx + beyond_x),
            *(cy / fy + beyond_y, (grid[1] - cy) / fy + beyond_y),
        )
        raster = None if lens is None or parallel else raster_of(lens, *grid, *intrinsics)
        return cls(
            width=camera.width * n,
            height=camera.height * n,
            samples=n,
            focal_x=fx,
            focal_y=fy,
            center_x=cx,
            center_y=cy,
            rotation=rotation,
            translation=rotated(-rotation, eye),
            # evaluate view-dependent colours of parallel rays from a distant eye
            eye=eye - FAR_EYE * rotation[2] if parallel else eye,
            near=camera.near,
            far=camera.far,
            log_alpha_cutoff=float(np.float32(math.log(quality.alpha_cutoff))),
            opacity_ceiling=float(np.float32(quality.opacity_ceiling)),
            transmittance_stop=float(np.float32(quality.transmittance_stop)),
            background=background if plain else (0.0, 0.0, 0.0),
            first_hit_transmittance=float(np.float32(1 - quality.first_hit)),
            sensor=capture.sensor,
            fog_density=0.0 if capture.fog is None else capture.fog.density,
            environment_map=None if plain else background,
            external_depth=external,
            raster=raster,
            ewa_clamp=ewa_clamp,
            along_ray=lens is not None and lens.along_ray,
            parallel=parallel,
        )


@dataclass(frozen=True)
class SubFrame:
    """One pose of a frame with a shutter."""

    view: View
    """the view at this pose, restricted to the sub-frame's rows"""
    top: int
    """first row of samples of the sub-frame in the frame"""
    weight: float
    """weight in the mean of all sub-frames of the same rows"""
    first: bool
    """whether it is the first sub-frame of its rows"""
    middle: bool
    """whether this is the middle sub-frame (n // 2 of n), from which all outputs except rgb and alpha are"""
