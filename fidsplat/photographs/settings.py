"""Settings of a capture from photographs."""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.util.arguments import whole_number
from fidsplat.util.errors import InputError, unknown

LENSES = {"pinhole": "PINHOLE", "radial": "RADIAL", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
"""lens of the photographs -> COLMAP's camera model"""


@dataclass(frozen=True)
class CaptureSettings:
    """Known sizes in the photographs, their lens, and sizes of the images.

    Raises InputError for invalid values.
    """

    tag: tuple[str, ...] = ()
    """SPEC=METRES: tag in the photographs, and the edge of its black square; repeat for several"""
    up: str | None = None
    """SPEC: tag with a vertical axis, on a wall or flat; else cameras are held level on average"""
    scale: str | None = None
    """A,B=METRES: distance of two points, each as NAME:X:Y, a pixel of the upright
    photograph"""
    lens: str = "opencv"
    """NAME: pinhole, radial (k1, k2), opencv (k1, k2, p1, p2) or fisheye"""
    frames: int = 150
    """N: largest number of frames of a video"""
    max_side: int = 1600
    """N: largest side of the images for training, in pixels"""

    def __post_init__(self) -> None:
        if self.lens not in LENSES:
            raise InputError(unknown("lens", self.lens, LENSES))
        whole_number("--frames", self.frames, 3, 10_000)
        whole_number("--max-side", self.max_side, 64, 32_767)
        if self.scale is not None and self.tag:
            raise InputError(
                "--scale must be given without --tag, whose size determines the scale, got both; omit one"
            )
