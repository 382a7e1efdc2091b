"""Yard: the scene of `fidsplat demo` with three signs, paving, bricks and shrubs, and its three views.

x right, y down, z away; the signs are at z = 0 and face -z. Stones and bricks differ by millimetres in depth,
since the order of coplanar splats would depend on rounding. Splats are disks, those of blooms and bushy
shrubs 3D Gaussians.
"""

import math
from dataclasses import replace

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.markers import marker
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.lights import Sun
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix

SKY = (0.70, 0.82, 0.93)
WIDTH, HEIGHT, FOV_X = 1280, 720, math.radians(60.0)
GROUND, WALL = 0.85, 1.6  # y of the ground and z of the wall, metres from the middle of the signs

# spec, edge in metres, position
SIGNS = (
    ("apriltag:36h11:5", 0.40, (-0.72, 0.0, 0.0)),
    ("aruco:4x4_50:7", 0.38, (0.0, 0.0, 0.0)),
    ("qr:fidsplat demo", 0.42, (0.74, 0.0, 0.0)),
)
OUTPUTS = ("rgb", "depth", "normal", "label")
SUN = Sun(direction=(-0.45, 0.9, 0.8), color=(1.0, 0.93, 0.8), intensity=2.6, angle=0.02, samples=4)


def demo_scene(seed: int = 0, mixture: str = "exact") -> Scene:
    """Signs of a mixture, ground, wall and plants: about ten thousand background splats with label 0."""
    random = np.random.default_rng(seed)
    placed = tuple(
        PlacedMarker(marker(spec, size=size, mixture=mixture), rigid_matrix(place))
        for spec, size, place in SIGNS
    )
    parts = [
        _ground(random),
        _wall(random),
        *_plants(random),
        *(_post(random, p) for p in placed),
    ]
    return Scene(
        (SplatCloud.concatenate(parts),),
        camera=demo_views()["frontal"],
        markers=placed,
        background=SKY,
        outputs=OUTPUTS,
    )


def sunlit(scene: Scene) -> Scene:
    """The scene with signs that are lit by the scene and by a sun over the viewer's right shoulder."""
    signs = tuple(replace(placed, light="scene") for placed in scene.markers)
    return replace(scene, markers=signs, lights=(SUN,))


def demo_views() -> dict[str, Camera]:
    """Cameras by name: from the front, from 60 degrees to the side, and past a plant that occludes part of a
    sign."""

    def around(degrees: float, distance: float, up: float, target) -> Camera:
        azimuth = math.radians(degrees)
        position = np.add(target, [distance * math.sin(azimuth), -up, -distance * math.cos(azimuth)])
        return Camera.look_at(WIDTH, HEIGHT, FOV_X, position, target)

    return {
        "frontal": around(0.0, 2.3, 0.0, (0.0, 0.05, 0.0)),
        "60 degrees": around(60.0, 2.3, 0.15, (0.0, 0.05, 0.0)),
        "hidden": around(-45.0, 2.5, 0.1, (0.05, 0.05, 0.0)),
    }


def _ground(random: np.random.Generator) -> SplatCloud:
    """Paving stones of 0.4 m."""
    tones = random.uniform(0.46, 0.62, (8, 13, 1)) * np.array([1.0, 0.95, 0.87])
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # columns: x, towards the camera, down
    corner = np.array([-2.6, GROUND, WALL])
    return _tiles(random, corner, down, (0.4, 0.4), tones, (6, 5), 0.0, (0.36, 0.34, 0.31))


def _wall(random: np.random.Generator) -> SplatCloud:
    """Courses of bricks, every second one shifted by half a brick."""
    tones = random.uniform(0.75, 1.15, (12, 15, 1)) * np.array([0.60, 0.33, 0.25])
    corner = np.array([-2.6, GROUND - 12 * 0.14, WALL])
    return _tiles(random, corner, np.eye(3), (0.35, 0.14), tones, (5, 2), 0.5, (0.70, 0.66, 0.60))


def _tiles(
    random: np.random.Generator, corner, axes: np.ndarray, pitch, tones: np.ndarray, grid, shift: float, joint
) -> SplatCloud:
    """Tiles in rows with joints between them.

    Args:
        corner: (3,) corner of the first tile.
        axes: (3, 3) columns: along a row, across the rows, normal.
        pitch: (2,) distance of tiles along and across, metres.
        tones: (rows, columns, 3) colour of each tile.
        grid: (2,) splats of a tile along and across.
        shift: offset of every second row, in tiles.
        joint: (3,) colour between tiles.
    """
    rows, columns = tones.shape[:2]
    pitch, grid = np.asarray(pitch), np.asarray(grid)
    row, column, i, j = np.meshgrid(*map(np.arange, (rows, columns, grid[0], grid[1])), indexing="ij")
    inner = (np.stack([i, j], -1) + 0.5) / grid * 0.9 + 0.05
    place = (np.stack([column + shift * (row % 2), row], -1) + inner).reshape(-1, 2) * pitch
    place += random.normal(0, 0.004, place.shape)
    colors = tones[row, column].reshape(-1, 3) * random.normal(1, 0.05, (len(place), 1))
    spread = np.broadcast_to(0.55 * 0.9 * pitch / grid, place.shape)

    # joints: thin splats along the rows, and between the tiles of a row
    step = np.arange(0, columns, 0.2)
    along = np.stack(np.meshgrid(step, np.arange(rows + 1.0), indexing="ij"), -1).reshape(-1, 2) * pitch
    row, column, j = np.meshgrid(np.arange(rows), np.arange(columns + 1), np.arange(3), indexing="ij")
    upright = np.stack([column + shift * (row % 2), row + (j + 0.5) / 3], -1).reshape(-1, 2) * pitch
    thin = 0.035 * pitch.min() + 0.001
    joints = np.concatenate([along, upright])
    widths = np.concatenate(
        [
            np.broadcast_to((0.12 * pitch[0], thin), along.shape),
            np.broadcast_to((thin, 0.2 * pitch[1]), upright.shape),
        ]
    )
    colors = np.concatenate([colors, np.asarray(joint) * random.normal(1, 0.05, (len(joints), 1))])
    flat = np.concatenate([place, joints])
    before = np.append(random.normal(0, 0.002, len(place)), random.normal(0.01, 0.001, len(joints)))
    means = np.asarray(corner) + flat @ axes[:, :2].T - before[:, None] * axes[:, 2]
    rotations = np.repeat(axes[None], len(flat), 0)
    return _cloud(means, rotations, np.concatenate([spread, widths]), 0.97, colors)


def _plants(random: np.random.Generator) -> list[SplatCloud]:
    """Shrubs, one of which occludes part of the middle sign in the third view."""
    green, dark, olive = (0.30, 0.52, 0.20), (0.16, 0.38, 0.18), (0.46, 0.50, 0.22)
    shrubs = (  # middle, half axes, leaves, whether bushy, colour, flowers
        ((-2.1, 0.35, 1.0), (0.55, 0.55, 0.55), 560, False, dark, None),
        ((-1.55, 0.60, 1.15), (0.32, 0.32, 0.32), 300, False, green, (0.95, 0.75, 0.20)),
        ((2.1, 0.30, 1.0), (0.60, 0.60, 0.60), 600, False, green, None),
        ((1.5, 0.58, 1.2), (0.34, 0.34, 0.34), 300, True, olive, (0.85, 0.30, 0.45)),
        ((0.37, 0.62, 1.2), (0.30, 0.30, 0.30), 280, True, dark, (0.93, 0.93, 0.96)),
        ((-0.37, 0.64, 1.25), (0.28, 0.28, 0.28), 260, False, green, None),
        ((-0.97, 0.38, -1.0), (0.17, 0.46, 0.17), 560, False, green, (0.90, 0.35, 0.35)),
    )
    return [_shrub(random, *shrub) for shrub in shrubs]


def _shrub(random: np.random.Generator, middle, axes, leaves: int, bushy, color, flowers) -> SplatCloud:
    """A shrub: leaves are disks, or thick tufts if bushy; blooms are spheres."""
    direction = random.normal(size=(leaves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = np.asarray(middle) + direction * np.asarray(axes) * np.cbrt(random.uniform(0.15, 1, (leaves, 1)))
    means[:, 1] = np.minimum(means[:, 1], GROUND - 0.01)
    rotations = np.linalg.qr(random.normal(size=(leaves, 3, 3)))[0]
    rotations *= np.sign(np.linalg.det(rotations))[:, None, None]
    light = 0.75 + 0.35 * (-direction[:, 1:2]) + random.normal(0, 0.08, (leaves, 1))  # brighter on top
    colors = np.asarray(color) * light
    blooms = np.zeros(leaves, bool)
    if flowers is not None:
        blooms = random.uniform(size=leaves) < 0.12
        colors[blooms] = np.asarray(flowers) * random.uniform(0.85, 1.05, (int(blooms.sum()), 1))
    scales = min(axes) * random.uniform((0.08, 0.04), (0.14, 0.065), (leaves, 2))
    scales = np.column_stack([scales, 0.5 * scales[:, 1] if bushy else np.zeros(leaves)])
    scales[blooms] = 1.2 * scales[blooms, 1:2]
    return _cloud(means, rotations, scales, 0.92, colors)


def _post(random: np.random.Generator, sign: PlacedMarker) -> SplatCloud:
    """A wooden post under a sign, from its lower edge to the ground."""
    count = 110
    top = float(sign.corners[2, 1]) + (sign.marker.quiet_zone + 0.5) * sign.marker.module
    y = np.linspace(top, GROUND, count)
    means = np.column_stack([np.full(count, sign.pose[0, 3]), y, np.full(count, 0.03)])
    means[:, 0] += random.normal(0, 0.012, count)
    colors = np.array([0.42, 0.29, 0.18]) * random.uniform(0.8, 1.15, (count, 1))
    facing = np.repeat(np.diag([1.0, -1.0, -1.0])[None], count, 0)
    return _cloud(means, facing, np.full((count, 2), 0.014), 0.95, colors)


def _cloud(means, rotations, scales, opacity: float, colors) -> SplatCloud:
    quats = np.array([matrix_to_quaternion(rotation) for rotation in rotations])
    return SplatCloud(means, quats, scales, np.full(len(means), opacity), colors=np.clip(colors, 0, 1))
