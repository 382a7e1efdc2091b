"""Camera: size, intrinsics, lens and pose."""

import math
import operator
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from fidsplat.cameras.foreign import colmap_arguments, nerfstudio_arguments, ros_arguments
from fidsplat.cameras.lenses import BrownConrady, Equirectangular, Fisheye, Lens, Orthographic
from fidsplat.splats.rotations import check_similarity, pose_matrix
from fidsplat.util.arguments import LARGEST, PickledByFields, invalid, real_array
from fidsplat.util.errors import InputError
from fidsplat.util.markup import Summarised, point

MAX_SIZE = 32767
"""largest width and height in pixels: pixel numbers fit 16 bits on every device"""

FOCAL_LENGTHS = 1e-6, 1e18
"""smallest and largest focal length in pixels: beyond them quadratic forms of splats exceed float32"""


@dataclass(frozen=True, eq=False)
class Camera(PickledByFields, Summarised):
    """Camera: size, intrinsics, lens and pose. A pinhole projects a point (X, Y, Z) of the camera frame to
    x = fx X / Z + cx, y = fy Y / Z + cy; a lens replaces X / Z and Y / Z.

    Pixel (row i, column j) has its centre at x = j + 0.5, y = i + 0.5. Raises InputError for invalid values,
    and for a distortion that cannot be inverted in half of the image.
    """

    width: int
    """pixels, 1 to 32767"""
    height: int
    """pixels, 1 to 32767"""
    fx: float
    """pixels, 1e-6 to 1e18"""
    fy: float
    """pixels, 1e-6 to 1e18"""
    cx: float
    """pixels, any value; width / 2 is the centre"""
    cy: float
    """pixels, any value; height / 2 is the centre"""
    world_to_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4) float64, rigid, read-only; or given as (position, quaternion w, x, y, z), the pose of the world
    in the camera frame"""
    near: float = 0.01
    """metres along z (along the ray for a fisheye or panorama), above 0; fragments nearer than this are
    clipped"""
    far: float = math.inf
    """metres, measured like near, above near; splats completely beyond it are not rendered"""

    position: np.ndarray = None  # type: ignore[assignment]
    """(3,) float64, centre of projection in the world, metres, read-only. By default it is computed from
    world_to_camera, which loses digits far from the origin; a camera made from a position stores it
    exactly"""

    lens: Lens | None = None
    """lens model; None: a pinhole, also for a lens whose coefficients are all 0"""

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        for name in ("width", "height"):
            set_field(self, name, _size(name, getattr(self, name)))
        for name in ("fx", "fy", "cx", "cy", "near", "far"):
            set_field(self, name, _number(name, getattr(self, name)))
        if not (0 < self.near < math.inf):
            raise InputError(f"camera near must be above 0 and finite, got {self.near!r}")
        smallest, largest = FOCAL_LENGTHS
        for name in ("fx", "fy"):
            if not smallest <= getattr(self, name) <= largest:
                raise InputError(
                    f"camera {name} must be between {smallest:g} and {largest:g} pixels, got "
                    f"{getattr(self, name)!r}; it is half the width / tan(half the field of view)"
                )
        for name in ("cx", "cy"):
            if not abs(getattr(self, name)) <= LARGEST:
                raise InputError(f"camera {name} must be finite, got {getattr(self, name)!r}")
        if not self.far > self.near:
            raise InputError(f"camera far must be above near ({self.near!r}), got {self.far!r}")
        self._set_pose(self.world_to_camera, self.position)
        if self.lens is not None:
            self._check_lens()

    def _set_pose(self, world_to_camera: Any, position: Any) -> None:
        """Set and validate the pose of a new camera."""
        pose = pose_matrix(world_to_camera, "camera world_to_camera")
        check_similarity(pose, "camera world_to_camera", rigid=True)
        matrix = np.array(pose, dtype=np.float64)
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
        if position is None:
            # the inverse, not the transpose: a rotation from a float32 file is orthonormal to 1e-7 only
            position = np.linalg.solve(rotation, -translation) + 0.0
        else:
            position = _vector("position", position)
            if np.abs(rotation @ position + translation).max() > 1e-6 * (1 + np.abs(position).max()):
                raise InputError(
                    "camera position must be the centre of projection of world_to_camera, got "
                    f"{tuple(position.tolist())}; omit it, or use camera.with_pose(world_to_camera)"
                )
        for name, array in (("world_to_camera", matrix), ("position", position)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def _posed(self, world_to_camera: Any, position: Any = None) -> "Camera":
        """A copy at another pose. The other fields are not validated again."""
        camera = object.__new__(Camera)
        camera.__dict__.update(self.__dict__)
        camera._set_pose(world_to_camera, position)
        return camera

    def _check_lens(self) -> None:
        lens = self.lens
        if not isinstance(lens, Lens):
            raise InputError(f"camera lens must be BrownConrady, Fisheye, ... or None, got {lens!r}")
        if lens.is_pinhole:
            object.__setattr__(self, "lens", None)
        elif not isinstance(lens, Orthographic):
            y, x = np.mgrid[0.5 : self.height : self.height / 24, 0.5 : self.width : self.width / 32]
            covered = np.isfinite(self.rays(np.stack([x.ravel(), y.ravel()], 1))[:, 0]).mean()
            if covered < 0.5 and isinstance(lens, BrownConrady):
                values = [(coefficient.name, getattr(lens, coefficient.name)) for coefficient in fields(lens)]
                listed = ", ".join(f"{name} = {value:g}" for name, value in values if value)
                raise InputError(
                    f"camera distortion must be invertible in half of the image, got {listed}, which is not "
                    f"invertible in {100 * (1 - covered):.0f} % of it; check the coefficients and the focal "
                    f"length ({self.fx:g} pixels)"
                )
            if covered == 0:
                raise InputError(
                    f"camera lens must have a pixel in its field of view, got none of a {lens.kind} lens; "
                    f"check fx, fy ({self.fx:g}, {self.fy:g} pixels per radian) and cx, cy ({self.cx:g}, "
                    f"{self.cy:g})"
                )

    @staticmethod
    def pinhole(
        width, height, fx, fy, cx, cy, world_to_camera=None, near=0.01, far=math.inf, position=None, lens=None
    ) -> "Camera":
        """A camera from intrinsics in pixels, a pose world_to_camera (4, 4), by default the identity, and a
        lens.

        position (3,): centre of projection in metres, if the pose was computed from it; it avoids a rounding
        error.
        """
        pose = np.eye(4) if world_to_camera is None else world_to_camera
        return Camera(width, height, fx, fy, cx, cy, pose, near, far, position, lens)  # type: ignore[arg-type]

    @staticmethod
    def fisheye(
        width, height, fov_x, world_to_camera=None, coefficients=(0.0, 0.0, 0.0, 0.0), near=0.01, far=math.inf
    ) -> "Camera":
        """A Kannala-Brandt fisheye with a horizontal field of view of ``fov_x`` radians, at most 200 degrees.

        coefficients: k1 to k4 of `cv2.fisheye`. `Camera.pinhole(..., lens=Fisheye(...))` accepts calibrated
        intrinsics.
        """
        factors = np.ravel(coefficients).tolist()
        if len(factors) != 4:
            raise InputError(f"a fisheye must have 4 coefficients, k1 to k4, got {len(factors)}")
        lens, width, height = Fisheye(*factors), _size("width", width), _size("height", height)
        f = fisheye_focal_length(width, fov_x, lens)
        intrinsics = f, f, width / 2, height / 2
        return Camera.pinhole(width, height, *intrinsics, world_to_camera, near, far, lens=lens)

    @staticmethod
    def equirectangular(width, height, world_to_camera=None, near=0.01, far=math.inf) -> "Camera":
        """A panorama of the sphere: z in the centre, -z at the left and right edges, -y at the top."""
        width, height = _size("width", width), _size("height", height)
        intrinsics = width / (2 * math.pi), height / math.pi, width / 2, height / 2
        return Camera.pinhole(width, height, *intrinsics, world_to_camera, near, far, lens=Equirectangular())

    @staticmethod
    def orthographic(width, height, metres_wide, world_to_camera=None, near=0.01, far=math.inf) -> "Camera":
        """An orthographic camera with square pixels whose image is ``metres_wide`` metres wide."""
        width, height = _size("width", width), _size("height", height)
        metres = _number("metres_wide", metres_wide)
        if not 0 < metres < math.inf:
            raise InputError(f"camera metres_wide must be above 0 and finite, got {metres_wide!r}")
        f = width / metres
        intrinsics = f, f, width / 2, height / 2
        return Camera.pinhole(width, height, *intrinsics, world_to_camera, near, far, lens=Orthographic())

    @staticmethod
    def look_at(
        width, height, fov_x, position, target, up=(0.0, -1.0, 0.0), near=0.01, far=math.inf
    ) -> "Camera":
        """A camera with square pixels at ``position`` whose optical axis passes through ``target``, metres.

        fov_x: horizontal field of view in radians, between 0 and pi. up: world direction that points up in
            the image; by default -y, as markers have y down.
        """
        width, height = _size("width", width), _size("height", height)
        f = focal_length(width, fov_x)
        pose = look_at_matrix(position, target, up)
        return Camera(width, height, f, f, width / 2, height / 2, pose, near, far, position)

    @staticmethod
    def from_colmap(camera, world_to_camera=None) -> "Camera":
        """A camera of COLMAP, which uses the same axes and pixel coordinates.

        Args:
            camera: a `pycolmap.Camera`, or (model, width, height, parameters) as in cameras.txt.
            world_to_camera: its pose, a `pycolmap.Image` or `Rigid3d`; by default the identity.

        Raises:
            InputError: another type of object, or an unsupported camera model. `load_cameras` reads files.
        """
        return Camera.pinhole(**colmap_arguments(camera, world_to_camera)._asdict())

    @staticmethod
    def from_nerfstudio(transforms, frame=0) -> "Camera":
        """The camera of a frame of nerfstudio's transforms.json; poses are converted from OpenGL's axes.

        Args:
            transforms: content of the file, a dict with the image size, w and h.
            frame: number of the frame, or its file_path.

        Raises:
            InputError: another content, or an unsupported camera model. `load_cameras` reads files.
        """
        return Camera.pinhole(**nerfstudio_arguments(transforms, frame)._asdict())

    @staticmethod
    def from_ros_camera_info(info, world_to_camera=None, *, rectified: bool = False) -> "Camera":
        """The camera of a `sensor_msgs/CameraInfo` of ROS 1 or 2, or of a ROS calibration file as a dict.

        Args:
            info: the message. ROS pixel coordinates are smaller by 0.5.
            world_to_camera: pose of the world in the camera's optical frame; by default the identity.
            rectified: the camera of rectified images, from P without distortion, instead of K and D.

        Raises:
            InputError: another type of object, an unsupported distortion model, binning, or a region of
                interest.
        """
        return Camera.pinhole(**ros_arguments(info, world_to_camera, rectified)._asdict())

    @property
    def camera_to_world(self) -> np.ndarray:
        """(4, 4) float64 pose of the camera in the world: the inverse of world_to_camera."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.world_to_camera[:3, :3].T, self.position
        return pose

    def with_pose(
        self,
        world_to_camera=None,
        *,
        camera_to_world=None,
        position=None,
        target=None,
        up=(0.0, -1.0, 0.0),
    ) -> "Camera":
        """The same camera (size, intrinsics, lens, near, far) at another pose.

        Args:
            world_to_camera, camera_to_world: (4, 4), rigid, or (position, quaternion w, x, y, z). Give only
                one of them, or position and target.
            position: (3,) metres, centre of projection; by default the camera's own.
            target: (3,) metres, a point on the new optical axis; by default the rotation is unchanged.
            up: (3,) world direction that points up in the image; used with a target.

        Raises:
            InputError: no pose, several poses, or a pose that is not rigid.
        """
        looks = position is not None or target is not None
        count = (world_to_camera is not None) + (camera_to_world is not None) + looks
        if count != 1:
            named = {"world_to_camera": world_to_camera, "camera_to_world": camera_to_world}
            named |= {"position": position, "target": target}
            given = " and ".join(name for name, value in named.items() if value is not None) or "none"
            raise InputError(
                "the pose of a camera must be given as world_to_camera, as camera_to_world, or as position, "
                f"target or both of these, got {given}"
            )
        if camera_to_world is not None:
            pose = pose_matrix(camera_to_world, "camera_to_world")
            rotation, _, position = check_similarity(pose, "camera_to_world", rigid=True)
            world_to_camera = np.eye(4)
            world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation.T, -rotation.T @ position
            return self._posed(world_to_camera, position)
        if world_to_camera is not None:
            return self._posed(world_to_camera)
        position = self.position if position is None else _vector("position", position)
        if target is not None:
            return self._posed(look_at_matrix(position, target, up), position)
        pose = self.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ position
        return self._posed(pose, position)

    def with_size(self, width: int, height: int) -> "Camera":
        """The same camera with another number of pixels. The horizontal field of view and the pixel aspect
        ratio are unchanged; rows are added or removed around the principal point. A panorama is scaled in
        both directions."""
        width, height = _size("width", width), _size("height", height)
        x = width / self.width
        y = height / self.height if isinstance(self.lens, Equirectangular) else x
        cy = height / 2 + (self.cy - self.height / 2) * y
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=cy
        )

    def resampled(self, width: int, height: int) -> "Camera":
        """The camera of an image that is resampled to another size, with a scale for each axis."""
        width, height = _size("width", width), _size("height", height)
        x, y = width / self.width, height / self.height
        intrinsics = {"fx": self.fx * x, "fy": self.fy * y, "cx": self.cx * x, "cy": self.cy * y}
        return replace(self, width=width, height=height, **intrinsics)

    def summary(self) -> dict[str, str]:
        """Size, intrinsics, lens and pose as text, for notebooks."""
        lens = self.lens
        changes = [] if lens is None else [(f.name, getattr(lens, f.name)) for f in fields(lens)]
        values = ", ".join(f"{name} = {value:g}" for name, value in changes if np.ndim(value) == 0 and value)
        return {
            "size": f"{self.width} x {self.height} pixels",
            "focal length": f"{self.fx:.6g}, {self.fy:.6g} pixels",
            "principal point": f"{self.cx:.6g}, {self.cy:.6g} pixels",
            "lens": "none" if lens is None else f"{lens.kind} {values}".strip(),
            "position": f"{point(self.position)} m",
            "looks along": point(self.world_to_camera[2, :3]),
        }

    @property
    def matrix(self) -> np.ndarray:
        """Intrinsic matrix K (3, 3) float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points) -> np.ndarray:
        """Pixel coordinates (n, 2) float64 of world points (n, 3); NaN behind the camera and outside the
        lens's field of view."""
        world = real_array("points", points)
        if world.ndim != 2 or world.shape[1] != 3:
            raise InputError(f"points must have the shape (n, 3), got {world.shape}")
        points = (world - self.position) @ self.world_to_camera[:3, :3].T
        if self.lens is not None:
            return self.lens.image(points) * (self.fx, self.fy) + (self.cx, self.cy)
        x, y, z = points.T
        z = np.where(z > 0, z, np.nan)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=1)

    @property
    def pixel_centers(self) -> np.ndarray:
        """Pixel coordinates x, y of the centres of all pixels, (h, w, 2) float64."""
        y, x = np.mgrid[0.5 : self.height, 0.5 : self.width]
        return np.stack([x, y], -1)

    def rays(self, pixels) -> np.ndarray:
        """Directions (n, 3) float64 in the camera frame of pixel coordinates (n, 2), with Z = 1, or of unit
        length for a fisheye or panorama; NaN outside the field of view. Raises InputError for an orthographic
        camera, whose rays are parallel."""
        image = real_array("pixels", pixels)
        if image.ndim != 2 or image.shape[1] != 2:
            raise InputError(f"pixels must have the shape (n, 2), got {image.shape}")
        image = (image - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.lens is None:
            return np.concatenate([image, np.ones((len(image), 1))], 1)
        if isinstance(self.lens, Orthographic):
            raise InputError(
                "lens must have rays from one point, got Orthographic, whose rays are parallel to z"
            )
        return self.lens.rays(image)

    def unproject(self, pixels, depths) -> np.ndarray:
        """World points (n, 3) float64 of pixel coordinates (n, 2) at depths (n,) in metres, defined as in the
        output `depth`; NaN outside the field of view."""
        depths = real_array("depths", depths)
        if depths.ndim != 1:
            raise InputError(f"depths must have the shape (n,), got {depths.shape}")
        if isinstance(self.lens, Orthographic):
            image = (real_array("pixels", pixels) - (self.cx, self.cy)) / (self.fx, self.fy)
            points = np.column_stack([image, depths])
        else:
            points = self.rays(pixels) * depths[:, None]
        return points @ self.world_to_camera[:3, :3] + self.position


def fisheye_focal_length(width: int, fov_x: float, lens: Fisheye) -> float:
    """Focal length in pixels of a fisheye with a width in pixels and a horizontal field of view in
    radians."""
    angle = _number("fov_x", fov_x)
    if not 1e-9 < angle <= 2 * lens.max_angle + 1e-12:
        raise InputError(
            f"camera fov_x of this fisheye must be between 0 and {math.degrees(2 * lens.max_angle):.4g} "
            f"degrees, got {math.degrees(angle):.6g}"
        )
    return width / 2 / float(lens.image_radius(angle / 2))


def focal_length(width: int, fov_x: float) -> float:
    """Focal length in pixels of a pinhole with a width in pixels and a horizontal field of view in
    radians."""
    width, angle = _size("width", width), _number("fov_x", fov_x)
    if not 1e-9 < angle < math.pi:
        remedy = f"math.radians({angle:g}) converts degrees" if 10 <= angle < 180 else ""
        raise invalid("camera fov_x", "between 0 and pi radians (180 degrees)", angle, remedy)
    return width / 2 / math.tan(angle / 2)


def look_at_matrix(position, target, up=(0.0, -1.0, 0.0)) -> np.ndarray:
    """world_to_camera (4, 4) float64 of a camera at ``position`` whose optical axis passes through
    ``target``. Raises InputError if both points coincide, or up is parallel to the axis."""
    eye, aim, upward = (_vector(n, v) for n, v in (("position", position), ("look_at", target), ("up", up)))
    forward = aim - eye
    distance = np.linalg.norm(forward)
    if not distance > 0:
        raise InputError(f"camera position and look_at must be different points, got {tuple(eye.tolist())}")
    forward /= distance
    length = np.linalg.norm(upward)
    if not length > 0:
        raise InputError("camera up must not be zero, got (0, 0, 0)")
    right = np.cross(forward, upward / length)
    if np.linalg.norm(right) < 1e-9:
        direction = " ".join(f"{x:g}" for x in np.eye(3)[np.abs(forward).argmin()])
        raise InputError(
            f"camera up must not be parallel to the optical axis, got {tuple(upward.tolist())}; give another "
            f"direction, such as {direction}, or move position or look_at"
        )
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ eye
    return matrix + 0.0  # removes the signs of zeros, which scene files would contain


def _size(name: str, value) -> int:
    try:
        if isinstance(value, bool):
            raise TypeError
        size = operator.index(value)
    except TypeError:
        raise InputError(f"camera {name} must be a whole number of pixels, got {value!r}") from None
    if not 1 <= size <= MAX_SIZE:
        raise InputError(f"camera {name} must be 1 to {MAX_SIZE} pixels, got {size}")
    return size


def _number(name: str, value) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"camera {name} must be a number, got {value!r}") from None


def _vector(name: str, value) -> np.ndarray:
    vector = real_array(f"camera {name}", value, "three numbers")
    if vector.shape != (3,) or not (np.abs(vector) <= LARGEST).all():
        raise InputError(f"camera {name} must be three numbers, at most {LARGEST:g}, got {value!r}")
    return vector
