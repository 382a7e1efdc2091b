"""Detection of AprilTag, ArUco and QR codes by OpenCV's aruco module, the AprilTag library (families of
AprilTag 3) and zxing-cpp.

`align` refines the corners by the edges of the decoded code.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import zxingcpp

from fidsplat.images.apriltag3 import HOLE, LAYOUTS, outside
from fidsplat.images.files import pixels_of
from fidsplat.images.tag_dictionaries import dictionary_bits, parse_family, predefined
from fidsplat.markers.kinds import detectors, parse_spec
from fidsplat.util.arguments import invalid, items
from fidsplat.util.errors import InputError
from fidsplat.vision.align import align, fit
from fidsplat.vision.apriltag_library import read_tags

# One family for each common grid size; less than one in 300 random dark squares decodes as a tag of these
# families. Only on request, since they take more time or have more false positives: 16h5 (1 in 30), 36h10
# and the families of 1000 tags (4x4_1000 to 7x7_1000).
DEFAULT_FAMILIES = ("36h11", "25h9", "4x4_50", "5x5_100", "6x6_250", "7x7_250")

MIN_SIDE = 8
"""minimum side of an image in pixels: the smallest tag has six modules"""
MAX_SIDE = 32767
"""maximum side in pixels for OpenCV's detector"""
MAX_QR_SIDE = 65535
"""maximum side in pixels for zxing-cpp"""
# factors by which the image is stretched if the first pass finds no QR code: modules of a tilted code are
# foreshortened
STRETCHES = (1.5, 2.0, 3.0, 4.0)
QR_ONLY = zxingcpp.BarcodeFormats([zxingcpp.BarcodeFormat.QRCode])


@dataclass(frozen=True, eq=False)
class Detection:
    """A detected code."""

    kind: str
    """"apriltag", "aruco", "qr" or a kind of another package; in results of `read_back` also a kind of
    board"""
    family: str
    """the tag's dictionary, e.g. "36h11"; for a QR code its version and error level, e.g. "v2-L" """
    id: int | None
    """id of a tag; None for QR codes and boards"""
    payload: str | None
    """text of a QR code; for a board e.g. "7x5:4x4_50"; None for a tag"""
    corners: np.ndarray
    """(4, 2) float64, pixels: TL, TR, BR, BL as printed, on the code's outer edge; pixel (i, j) has its
    centre at (j + 0.5, i + 0.5)"""

    @property
    def name(self) -> str:
        """Marker spec of the code, e.g. "apriltag:36h11:5" or "qr:some text"."""
        return f"{self.kind}:{self.payload if self.id is None else f'{self.family}:{self.id}'}"


def detect(image: np.ndarray, families: Iterable[str] | None = None, qr: bool = True) -> list[Detection]:
    """Detect all codes in an image: tags in the order of `families` and ids, then QR codes.

    Args:
        image: (h, w, 3) RGB or (h, w) grey, uint8.
        families: tag families to detect ("36h11" or "apriltag:36h11"); None for `DEFAULT_FAMILIES`; () for
            none. Kinds of other packages are named like families; None includes those with a detector.
        qr: whether to detect QR codes.

    A tag that decodes in two families (the small ArUco families are parts of the large ones) is reported
    once, in the first of them. Raises InputError for an unknown family or an invalid array.
    """
    pixels = pixels_of(image)
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise InputError(f"the image must be uint8 (h, w) or (h, w, 3), got {pixels.dtype} {pixels.shape}")
    if isinstance(families, str):
        raise invalid("families", "several names", families, "write ('36h11',)")
    if families is not None:
        families = items("families", families, str, "several names, as ('36h11',)")
    if not isinstance(qr, bool | np.bool_ | int):
        raise InputError(f"qr must be True or False, got a {type(qr).__name__}")
    hooks = detectors()
    names = (*DEFAULT_FAMILIES, *detectors(default=True)) if families is None else families
    requested = [parse_family(name) for name in names if name not in hooks]
    if min(pixels.shape[:2]) < MIN_SIDE:
        return []
    if max(pixels.shape[:2]) > MAX_SIDE:
        raise InputError(
            f"an image must have at most {MAX_SIDE} pixels a side for detection, got {pixels.shape[1]} x "
            f"{pixels.shape[0]}; crop or downsample it"
        )
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if pixels.ndim == 3 else np.ascontiguousarray(pixels)
    detections: list[Detection] = []
    for kind, family in dict.fromkeys(requested):
        detections += [tag for tag in _tags(grey, kind, family) if not _known(tag, detections)]
    for name in names:
        if name in hooks:
            detections += [_of_hook(*code) for code in hooks[name](grey)]
    return detections + (_qr_codes(grey) if qr else [])


def _of_hook(text: str, corners: np.ndarray) -> Detection:
    spec = parse_spec(text)
    return Detection(spec.kind, spec.family or "", spec.id, spec.payload, np.asarray(corners, np.float64))


def _tags(grey: np.ndarray, kind: str, family: str) -> list[Detection]:
    """Tags of one family, sorted by id."""
    detections: list[Detection] = []
    if family in LAYOUTS:
        ring = outside(family)
        for number, corners in read_tags(grey, family):
            inner = dictionary_bits(kind, family, number)[ring:-ring, ring:-ring]
            better = align(grey, corners, inner * (inner != HOLE))
            detections.append(Detection(kind, family, number, None, corners if better is None else better))
        return sorted(detections, key=lambda tag: tag.id or 0)
    loose: list[Detection] = []
    # OpenCV's AprilTag method finds tags whose white margin is crossed by a thin dark line, which breaks the
    # contours of the first method. At half size it costs no more; the first method finds the small tags.
    for refinement, decimate in (
        (cv2.aruco.CORNER_REFINE_SUBPIX, 0.0),
        (cv2.aruco.CORNER_REFINE_APRILTAG, 2.0),
    ):
        _read_tags(grey, kind, family, refinement, decimate, detections, loose)
    if any(not _known(tag, detections) for tag in loose):
        # OpenCV approximates a contour by four points to within 3 % of its length: on a steeply tilted tag
        # corners can be modules away from the true ones, outside the window of the refinement. Fitting lines
        # to the sides solves this, but dark lines that touch the tag rotate them.
        _read_tags(grey, kind, family, cv2.aruco.CORNER_REFINE_CONTOUR, 0.0, detections, loose)
    # if the fit converges from none of the candidate corners, use those with the best correlation
    bits = {tag.id: dictionary_bits(kind, family, int(tag.id or 0)) for tag in loose}
    for tag in sorted(loose, key=lambda tag: -fit(grey, tag.corners, bits[tag.id])):
        if not _known(tag, detections):
            detections.append(tag)
    return sorted(detections, key=lambda tag: tag.id or 0)


def _read_tags(
    grey: np.ndarray,
    kind: str,
    family: str,
    refinement: int,
    decimate: float,
    detections: list[Detection],
    loose: list[Detection],
) -> None:
    """Detect further tags with a method of corner refinement.

    Tags whose alignment converges are appended to `detections`, others, with OpenCV's corners, to `loose`.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    parameters.aprilTagQuadDecimate = decimate
    quads, ids, _ = cv2.aruco.ArucoDetector(predefined(kind, family), parameters).detectMarkers(grey)
    for quad, tag_id in zip(quads, [] if ids is None else ids.ravel(), strict=True):
        # OpenCV counts from the centre of the first pixel
        rough = quad.reshape(4, 2).astype(np.float64) + 0.5
        tag = Detection(kind, family, int(tag_id), None, rough)
        if not _known(tag, detections):
            # a dark line that touches a corner can shift it by a module
            better = align(grey, rough, dictionary_bits(kind, family, int(tag_id)), unsure=range(4))
            (loose if better is None else detections).append(
                tag if better is None else replace(tag, corners=better)
            )


def _known(tag: Detection, detections: Iterable[Detection]) -> bool:
    return any(_overlapping(tag, old) for old in detections)


def _overlapping(one: Detection, other: Detection) -> bool:
    edge, second = (np.linalg.norm(t.corners - np.roll(t.corners, 1, 0), axis=1).max() for t in (one, other))
    # a tag in the hole of a recursive tag is less than half as large
    alike = 0.5 < edge / max(second, 1e-9) < 2
    return bool(alike and np.linalg.norm(one.corners.mean(0) - other.corners.mean(0)) < 0.25 * edge)


def _qr_codes(grey: np.ndarray) -> list[Detection]:
    codes = _read_qr(grey, 1.0, 1.0)
    for factor in STRETCHES:
        # taller first: codes are tilted backwards more often than sideways
        codes = codes or _read_qr(grey, 1.0, factor) or _read_qr(grey, factor, 1.0)
    return sorted(codes, key=lambda code: (code.payload or "", tuple(code.corners[0])))


def _read_qr(grey: np.ndarray, wider: float, taller: float) -> list[Detection]:
    image = grey
    if max(grey.shape[1] * wider, grey.shape[0] * taller) > MAX_QR_SIDE:
        return []
    if (wider, taller) != (1.0, 1.0):
        image = cv2.resize(grey, None, fx=wider, fy=taller, interpolation=cv2.INTER_LINEAR)
    scale = np.array([grey.shape[1] / image.shape[1], grey.shape[0] / image.shape[0]])
    read = zxingcpp.read_barcodes(image, formats=QR_ONLY, text_mode=zxingcpp.TextMode.Plain)
    return [_qr(grey, code, scale) for code in read]


def corners_of(code: zxingcpp.Barcode) -> np.ndarray:
    """Corners of a barcode, (4, 2) pixels, TL, TR, BR, BL as printed."""
    place = code.position
    points = (place.top_left, place.top_right, place.bottom_right, place.bottom_left)
    return np.array([(point.x, point.y) for point in points], np.float64)


def _qr(grey: np.ndarray, code: zxingcpp.Barcode, scale: np.ndarray) -> Detection:
    rough = corners_of(code) * scale
    bits = (np.array(code.to_image(scale=1, add_quiet_zones=False)) == 0).astype(np.uint8)
    # the fourth corner has no finder pattern, and in the smallest codes no alignment pattern: it can be off
    # by a module
    better = align(grey, rough, bits, unsure=(2,))
    version = (bits.shape[0] - 17) // 4
    family = f"v{version}-{code.ec_level}"
    return Detection("qr", family, None, code.text, rough if better is None else better)
