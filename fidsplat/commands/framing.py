"""A camera for splats that came without one."""

import math

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.store import Store

WIDTH, HEIGHT = 1280, 720
FOV_X = math.radians(60.0)
MARGIN = 1.1
# a splat counts as far as it is plainly seen; at 3 standard deviations it would be fitted tails that fill
# the picture
REACH = 1.5
# captured scenes have strays far away; a cloud of this many is framed without the outermost 1 % of its splats
MANY = 10_000


def framing_camera(cloud: SplatCloud | Store) -> Camera:
    """A camera on the -z side, y down, that sees all of the splats; 1280 x 720 pixels, 60 degrees wide."""
    low, high = _extent(cloud)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
    tangent = math.tan(FOV_X / 2)
    away = MARGIN * max(half[0] / tangent, half[1] / (tangent * HEIGHT / WIDTH)) + half[2]
    return Camera.look_at(WIDTH, HEIGHT, FOV_X, middle - [0, 0, away], middle, near=min(0.01, away / 100))


def _extent(cloud: SplatCloud | Store) -> tuple[np.ndarray, np.ndarray]:
    if len(cloud) == 0:
        return -np.ones(3), np.ones(3)
    if isinstance(cloud, Store):  # its chunks are small against it
        return cloud.bounds(REACH)
    reach = cloud.reach(REACH)
    share = 0.5 if len(cloud) >= MANY else 0.0
    low = np.percentile(cloud.means - reach, share, axis=0)
    high = np.percentile(cloud.means + reach, 100 - share, axis=0)
    return low + cloud.origin, high + cloud.origin
