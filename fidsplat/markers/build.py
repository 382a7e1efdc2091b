"""Construction of the splats of a marker from its spec."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fidsplat.capture.quality import MarkerQuality
from fidsplat.images.apriltag3 import HOLE
from fidsplat.markers.bending import FINE, GAP, bend, fine, subdivide, surface_frames
from fidsplat.markers.facets import count_facets, facet_cloud
from fidsplat.markers.kinds import bits_of, kind_of, parse_spec
from fidsplat.markers.mixture import (
    Template,
    count_gaussians,
    fitted_growth,
    fitted_templates,
    paper_template,
)
from fidsplat.markers.partition import minimum_rectangles, partition_colors
from fidsplat.markers.printing import (
    MAX_SPLATS,
    Printed,
    aspect_of,
    box_cloud,
    gaussian_cloud,
    refuse_more,
    without_slivers,
)
from fidsplat.markers.regions import label_components, polygons
from fidsplat.markers.spec import Spec
from fidsplat.markers.surfaces import SheetShape, shape_of
from fidsplat.markers.wear import Wear, wear_of, worn
from fidsplat.util.arguments import (
    PickledByFields,
    flag,
    instance,
    invalid,
    number,
    real_array,
    text,
    whole_number,
)
from fidsplat.util.errors import InputError, unknown

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.progress import Progress

Ink = tuple[float, float, float]
_INKS: tuple[Ink, Ink] = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

MAX_MODULES = 4096
"""Maximum edge of a grid with its quiet zone, in modules."""

_SETTINGS = {
    "exact": ("template",),
    "fitted": ("template", "growth"),
    "paper": ("levels", "density", "duplicates", "growth"),
    "facets": (),
}
"""settings of each mixture; `template` of `exact` is for `Marker.gaussians`"""


class Rectangle(NamedTuple):
    """A rectangle of a partition: half-open ranges in modules of the grid with quiet zone, x right, y
    down."""

    x0: float
    y0: float
    x1: float
    y1: float
    dark: bool


@dataclass(frozen=True, eq=False)
class Marker(PickledByFields):
    """A fiducial marker and its splats, made by `marker`."""

    spec: str
    """text of the spec"""
    kind: str
    """name of its kind: "apriltag", "aruco", "qr", "image", "svg", "charuco", "gridboard", "aprilgrid", or
    a registered one"""
    family: str | None
    """tag family of a tag or board, e.g. "36h11"; QR version and level, e.g. "v5-L"; None for images"""
    id: int | None
    """tag id; None for other kinds"""
    payload: str | None
    """text of a QR code, path of an image or an SVG drawing; None for tags and boards"""
    bits: np.ndarray
    """(h, w) uint8, 1 = dark, 255 = no paper, the code without quiet zone; indices of `palette` for
    drawings"""
    quiet_zone: int
    """modules of white around the code"""
    size: float
    """edge of the code in metres; its width if it is not square; of the border for AprilTag 3"""
    mixture: str
    """"exact", "fitted", "facets", "paper", or "refined" (`fidsplat.train.refine`)"""
    quality: MarkerQuality
    """quality settings; `growth` is None for the mixture's default"""
    grid: np.ndarray = field(repr=False)
    """(H, W) uint8, the code with its quiet zone"""
    boxes: np.ndarray = field(repr=False)
    """(n, 4) int64 x0, y0, x1, y1: the minimum partition of the grid, in modules; float64 for drawings with
    slanted or curved edges, before rotation by `angles`"""
    values: np.ndarray = field(repr=False)
    """(n,) uint8, index of `palette` of each rectangle"""
    angles: np.ndarray | None = field(repr=False)
    """(n,) radians, rotation of each about its centre, from x to y; None: no rotation"""
    regions: tuple[MultiPolygon, ...] | None = field(repr=False)
    """region of each value for drawings with slanted or curved edges, in modules of the grid; else None"""
    labels: np.ndarray = field(repr=False)
    """(H, W) int32, the 4-connected component of each module of the grid"""
    components: int
    """number of components, all colours"""
    palette: np.ndarray = field(repr=False)
    """(k, 3) float32 RGB, colours of the grid's values: white and black, or a drawing's colours, paper
    first"""
    cloud: SplatCloud = field(repr=False)
    """the splats in the marker's frame: plane z = 0, x right, y down as printed, origin at the code's
    centre
    """
    seconds: float
    """time from the spec to the cloud"""
    max_splats: int = MAX_SPLATS
    """maximum number of splats"""
    outside: int = 0
    """modules of the code on each side of the square that `size` and `corners` measure"""
    inks: tuple[Ink, Ink] | None = None
    """RGB of the dark and of the light modules, as given; None: black and white, or a drawing's colours"""
    shape: SheetShape | None = None
    """surface that the sheet is bent to; None: flat"""
    wear: Wear | None = None
    """print defects and wear of the splats; grid and rectangles describe the new marker; None: none"""

    def __repr__(self) -> str:
        return (
            f"Marker({self.spec!r}, {self.size:g} m, {len(self.boxes)} rectangles, {len(self.cloud)} splats)"
        )

    def _repr_png_(self) -> bytes:
        """PNG of the printed code for notebooks; modules without paper are grey."""
        from fidsplat.images.files import encode_png  # here, since it imports OpenCV

        holes = (self.grid == HOLE)[..., None]
        modules = np.where(holes, 0.5, self.palette[np.where(self.grid == HOLE, 0, self.grid)])
        pixels = max(1, 256 // max(self.grid.shape))
        return encode_png(modules.repeat(pixels, 0).repeat(pixels, 1))

    @property
    def module(self) -> float:
        """Metres per module."""
        return self.size / (self.bits.shape[1] - 2 * self.outside)

    @property
    def radius(self) -> float:
        """Metres from the centre to the corners of the quiet zone."""
        return self.module * math.hypot(*self.grid.shape) / 2

    @cached_property
    def gaussians(self) -> SplatCloud:
        """The marker as Gaussians, for renderers and files without boxes.

        The same as `cloud`, except for the mixture `exact` of boxes, for which it is the mixture `fitted` of
        the same marker.

        Raises:
            InputError: more than `max_splats`.
        """
        if self.mixture != "exact":
            return self.cloud
        printed = Printed(
            self.grid, self.boxes, self.values, self.angles, self.regions, self.module, self.palette
        )
        printed = printed if self.wear is None else worn(self.spec, printed, self.wear)
        mixture = fitted_templates(self.quality.template), fitted_growth()
        sheet = _Sheet(f"as Gaussians {self.spec}", self.size, self.module, self.max_splats, self.shape)
        return sheet.gaussians(printed, *mixture, lambda task, fraction: None)

    @cached_property
    def rectangles(self) -> list[Rectangle]:
        """Minimum partition of all components, in raster order; for drawings with slanted edges their cover,
        before rotation by `angles`."""
        dark = self.is_dark
        return [Rectangle(*row) for row in zip(*self.boxes.T.tolist(), dark.tolist(), strict=True)]

    @property
    def is_dark(self) -> np.ndarray:
        """Mask (n,) of the rectangles that are nearer to black than to white."""
        limit = 0.5 if self.inks is None else self.palette.mean()
        return (self.palette.mean(1) < limit)[self.values]

    @cached_property
    def polygons(self) -> list[Polygon]:
        """Polygons of the components, with holes, in modules of the grid (needs shapely)."""
        if self.regions is not None:
            return [polygon for region in self.regions for polygon in region.geoms]
        return polygons(self.grid, self.labels, self.components)

    @property
    def corners(self) -> np.ndarray:
        """(4, 3) float64 metres: outer corners of the code, for AprilTag 3 of its border: top left, top
        right, bottom right, bottom left as printed; on the surface of a bent marker.
        """
        return self.points(self.flat_corners)

    @property
    def flat_corners(self) -> np.ndarray:
        """(4, 2) float64 metres: positions of `corners` on the flat sheet."""
        h, w = np.array(self.bits.shape) - 2 * self.outside
        x, y = w * self.module / 2, h * self.module / 2
        return np.array([[-x, -y], [x, -y], [x, y], [-x, y]])

    def points(self, xy: np.ndarray) -> np.ndarray:
        """Points (n, 3) float64 in the marker's frame [m] of positions (n, 2) on its sheet [m], x right and y
        down from the centre.

        Raises:
            InputError: an array of another shape.
        """
        at = real_array("xy", xy, "(n, 2) metres on the sheet")
        if at.ndim != 2 or at.shape[1] != 2:
            raise InputError(f"xy must be an array (n, 2) in metres, got the shape {at.shape}")
        return surface_frames(self.shape, np.asarray(at, np.float64)).points


def marker(
    spec: str,
    size: float = 1.0,
    mixture: str | None = None,
    quiet_zone: int | None = None,
    *,
    levels: int | None = None,
    density: int | None = None,
    duplicates: bool | None = None,
    growth: float | None = None,
    template: int | None = None,
    black: Ink | None = None,
    white: Ink | None = None,
    quality: MarkerQuality | None = None,
    shape: SheetShape | str | None = None,
    wear: Wear | str | None = None,
    max_splats: int = MAX_SPLATS,
    progress: Progress | None = None,
) -> Marker:
    """Make a marker of splats.

    Args:
        spec: apriltag:36h11:5, aruco:4x4_50:7, qr:TEXT, qr-v22-L:TEXT, image:FILE.png, svg:FILE.svg,
            charuco:7x5:4x4_50, gridboard:5x7:4x4_50, aprilgrid:6x6:36h11, or a registered kind.
        size: metres, edge of the code itself, without quiet zone (the width of a board or an image).
        mixture: "exact" (default), a box for each rectangle, which only fidsplat renders
            (`SplatCloud.with_boxes`; `Marker.gaussians` are for other renderers and for files); "fitted" or
            "paper": Gaussians; "facets": Gaussians for renderers that sort by depth at each pixel, only for
            markers that consist of modules.
        quiet_zone: width of the white margin in modules; default 1 for tags, 4 for QR, 2 for boards, 0 for
            images and drawings.
        levels, density, duplicates: of the mixture `paper` only, see `paper_template`; default 4, 3, False.
        template: of the mixtures `fitted` and (for `Marker.gaussians`) `exact` only: Gaussians of a
            rectangle, 1, 5, 9, 13, 25, 41, 121 or 562; default 25.
        growth: distance in modules, 0 to 1, by which a rectangle extends into neighbours of its own colour,
            to close seams; default: the value for which the fitted templates are optimised, 0 for paper.
        black, white: RGB of the dark and light modules in [0, 1], black darker than white; default (0, 0, 0)
            and (1, 1, 1). Printed ink and paper are nearer to (0.05, 0.05, 0.05) and (0.85, 0.85, 0.85);
            with `light`, which has reflectances of its own, keep the defaults.
        quality: defaults of mixture, levels, density, growth and template (`Quality.marker`); settings of
            other mixtures are ignored.
        shape: surface that the sheet is bent to, such as `fidsplat.markers.Cylinder(radius=0.05)`, or its
            text "cylinder,radius=0.05"; not for facets.
        wear: print defects and wear, such as `fidsplat.markers.Wear(fading=0.4)`, or its text
            "fading=0.4,dirt=0.2,seed=3"; not for facets or drawings with slanted edges.
        max_splats: maximum number of splats; a noisy image may need tens of millions.
        progress: callback of the current task and its completed fraction, 0 to 1.

    Raises:
        InputError: an invalid argument, or more splats than `max_splats`.
    """
    start = time.perf_counter()
    progress = (lambda task, fraction: None) if progress is None else progress
    max_splats = whole_number("max_splats", max_splats, 1, 2**31 - 1)
    parsed = parse_spec(spec)
    changes = {"levels": levels, "density": density, "growth": growth, "template": template}
    changes["duplicates"] = None if duplicates is None else flag("duplicates", duplicates)
    chosen = _chosen(MarkerQuality() if quality is None else quality, mixture, changes)
    templates, growth = _mixture(chosen, bool(duplicates))
    # outside, a module or a splat's scale would exceed the range of float32
    size = number("size", size, "a length from 1e-9 to 1e9 metres", 1e-9, 1e9)
    parsed, bits = bits_of(parsed)
    quiet = _quiet_zone(spec, parsed, bits, quiet_zone)
    grid = np.pad(bits, quiet)
    min_splats = 1 if chosen.mixture == "exact" else min(len(template.gaussians) for template in templates)
    inks = None if black is None and white is None else _inks(parsed, black, white)
    palette = np.array(parsed.colors or (inks or _INKS)[::-1], np.float32)
    surface, old = shape_of(shape), wear_of(wear)
    if chosen.mixture == "facets" and not (surface is None and old is None):
        raise InputError(
            "mixture must be exact, fitted or paper for a marker with shape or wear, got facets; use exact"
        )
    if surface is not None:
        surface.fit(_half(grid, size / (bits.shape[1] - 2 * parsed.outside)))
    if chosen.mixture == "facets":
        refuse_more(spec, count_facets(grid.shape), max_splats)
    elif len(palette) == 2 and grid.max() <= 1:
        refuse_more(spec, minimum_rectangles(grid) * min_splats, max_splats, "at least ")
    progress("components", 0.0)
    labels, components = label_components(grid)
    progress("rectangles", 0.0)
    printed = _printed(grid, parsed, quiet, size / (bits.shape[1] - 2 * parsed.outside), palette)
    boxes, values, angles, regions = printed.boxes, printed.values, printed.angles, printed.regions
    if regions is not None:
        components = sum(len(region.geoms) for region in regions)
    sheet = _Sheet(spec, size, printed.module, max_splats, surface)
    printed = printed if old is None else worn(spec, printed, old)
    if chosen.mixture == "facets":
        cloud = facet_cloud(spec, printed, progress)
    elif chosen.mixture == "exact":
        cloud = sheet.boxes(printed, progress)
    else:
        cloud = sheet.gaussians(printed, templates, growth, progress)
    for array in (bits, grid, boxes, values, angles, labels, palette):
        if array is not None:
            array.flags.writeable = False
    return Marker(
        spec=spec,
        kind=parsed.kind,
        family=parsed.family,
        id=parsed.id,
        payload=parsed.payload,
        bits=bits,
        quiet_zone=quiet,
        size=size,
        mixture=chosen.mixture,
        quality=chosen,
        grid=grid,
        boxes=boxes,
        values=values,
        angles=angles,
        regions=regions,
        labels=labels,
        components=components,
        palette=palette,
        cloud=cloud,
        seconds=time.perf_counter() - start,
        max_splats=max_splats,
        outside=parsed.outside,
        inks=inks,
        shape=surface,
        wear=old,
    )


def _half(grid: np.ndarray, module: float) -> tuple[float, float]:
    """Half edges of the sheet in metres."""
    return grid.shape[1] * module / 2, grid.shape[0] * module / 2


class _Sheet(NamedTuple):
    """Conversion of printed rectangles to splats, on the plane or on a surface."""

    spec: str
    size: float
    module: float
    max_splats: int
    surface: SheetShape | None

    def boxes(self, printed: Printed, progress: Progress) -> SplatCloud:
        """One box for each rectangle; on a bent marker one for each flat piece of it."""
        refuse_more(self.spec, len(printed.boxes), self.max_splats)
        if self.surface is None:
            return box_cloud(printed, progress)
        pieces = subdivide(self.spec, printed, self.surface, self._deviation, self.max_splats)
        return self._bent(box_cloud(pieces, progress), printed)

    def gaussians(
        self, printed: Printed, templates: tuple[Template, ...], growth: float, progress: Progress
    ) -> SplatCloud:
        """Gaussians of each rectangle; on a bent marker of each flat piece of it."""
        filled = without_slivers(printed)
        if self.surface is not None:
            along_modules = printed.regions is None
            filled = fine(filled) if along_modules and printed.module == self.module else filled
            filled = subdivide(
                self.spec, filled, self.surface, self._deviation, self.max_splats, along_modules
            )
        refuse_more(
            self.spec, int(count_gaussians(aspect_of(filled.boxes), templates).sum()), self.max_splats
        )
        cloud = gaussian_cloud(filled, templates, growth, progress)
        return cloud if self.surface is None else self._bent(cloud, printed)

    @property
    def _deviation(self) -> float:
        """Largest distance [m] of the pieces from the surface, except for copies of pieces at the borders of
        coplanar groups, which are offset by `GAP` times this distance."""
        requested = None if self.surface is None else self.surface.deviation
        return (self.size / FINE if requested is None else requested) / (1 + GAP)

    def _bent(self, flat: SplatCloud, printed: Printed) -> SplatCloud:
        assert self.surface is not None
        half = _half(printed.grid, printed.module)
        return bend(flat, self.surface, half, self.module, self._deviation)


def _inks(parsed: Spec, black: Ink | None, white: Ink | None) -> tuple[Ink, Ink]:
    """Validated RGB of the dark and light modules."""
    if parsed.colors is not None:
        raise InputError(
            f"black and white must be left out for a drawing with own colours, got {parsed.text}"
        )
    inks = []
    for name, given, default in zip(("black", "white"), (black, white), _INKS, strict=True):
        color = real_array(name, default if given is None else given, "three numbers from 0 to 1")
        if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
            raise invalid(name, "three numbers from 0 to 1", given)
        inks.append(tuple(color.tolist()))
    if not np.mean(inks[0]) < np.mean(inks[1]):
        raise InputError(f"black must be darker than white, got {inks[0]} and {inks[1]}")
    return inks[0], inks[1]


def _quiet_zone(spec: str, parsed: Spec, bits: np.ndarray, modules: int | None) -> int:
    """Validated width of the quiet zone in modules; None: the default of the kind."""
    longest = MAX_MODULES - max(bits.shape)
    if longest < 0:
        raise InputError(
            f"{spec} must have at most {MAX_MODULES} modules a side, got {bits.shape[1]} x {bits.shape[0]}"
        )
    round_tag = bits.size > 0 and bits[0, 0] == HOLE
    width = kind_of(parsed).quiet_zone * (not round_tag) if modules is None else modules
    if round_tag and width != 0:
        raise InputError(f"the quiet zone of a round tag must be 0, got {width!r} for {spec}")
    return whole_number("the quiet zone", width, 0, longest // 2)


def _printed(grid: np.ndarray, parsed: Spec, quiet: int, module: float, palette: np.ndarray) -> Printed:
    """Rectangles of a marker: the partition of its modules, or the cover of a drawing's shapes."""
    if parsed.regions is None:
        boxes = partition_colors(grid)
        boxes = boxes[grid[boxes[:, 1], boxes[:, 0]] != HOLE]
        return Printed(grid, boxes, grid[boxes[:, 1], boxes[:, 0]], None, None, module, palette)
    from fidsplat.markers.cover import cover_all  # here, since it imports shapely
    from fidsplat.markers.shapes import with_margin

    regions = with_margin(parsed.regions, quiet, grid.shape)
    boxes, angles, values = cover_all(regions, grid.shape)
    return Printed(grid, boxes, values, angles, regions, module, palette)


def _chosen(quality: MarkerQuality, mixture: str | None, changes: dict[str, Any]) -> MarkerQuality:
    """Quality settings with changes; None keeps a setting."""
    instance("quality", quality, MarkerQuality, "an fs.MarkerQuality, e.g. fs.Quality(...).marker")
    name = quality.mixture if mixture is None else text("mixture", mixture)
    if name == "refined":
        raise InputError(
            "mixture must be computed without a device, got 'refined'; give a marker with the mixture "
            "'fitted' to fs.train.refine, or run `fidsplat marker --mixture refined`"
        )
    if name not in _SETTINGS:
        raise InputError(unknown("mixture", name, _SETTINGS))
    changes = {key: value for key, value in changes.items() if value is not None}
    for key in changes:
        users = [mixture for mixture, settings in _SETTINGS.items() if key in settings]
        if name not in users:
            raise InputError(
                f"{key} must be given with mixture {' or '.join(users)}, got {name}; leave it out, or write "
                f"mixture={users[0]!r}"
            )
    changes.pop("duplicates", None)
    return replace(quality, mixture=name, **changes)


def _mixture(quality: MarkerQuality, duplicates: bool) -> tuple[tuple[Template, ...], float]:
    """Templates and growth of a mixture; for `exact`, of `Marker.gaussians`."""
    if quality.mixture == "paper":
        gaussians = paper_template(quality.levels, quality.density, duplicates)
        templates, growth = (Template(math.inf, gaussians),), 0.0
    else:
        templates, growth = fitted_templates(quality.template), fitted_growth()
    return templates, growth if quality.growth is None else float(quality.growth)
