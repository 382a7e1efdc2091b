"""Drawings: the filled shapes of an SVG file in their colours, as polygons with holes.

What is drawn are the polygons themselves; `Marker.bits` have in each module the topmost shape that holds its
centre. Everything that is filled in one colour is understood; what would have to be left out (text, strokes,
gradients, pictures) is an error, so that no drawing comes out other than it looks.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fidsplat.errors import InputError
from fidsplat.markers.paths import FARTHEST, Rings, circle_rings, number, path_rings, polygon_rings
from fidsplat.markers.spec import Kind, Spec

MODULES = 256
"""Modules across a drawing unless its spec says otherwise."""

MOST_MODULES, MOST_BYTES, MOST_COLORS, MOST_POINTS = 2048, 2_000_000, 64, 200_000

_HEAD = re.compile(r"svg(?:-(?P<modules>[0-9]{1,5}))?", re.IGNORECASE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NAMED = {
    "black": "#000", "white": "#fff", "red": "#f00", "lime": "#0f0", "green": "#008000", "blue": "#00f",
    "yellow": "#ff0", "cyan": "#0ff", "aqua": "#0ff", "magenta": "#f0f", "fuchsia": "#f0f", "gray": "#808080",
    "grey": "#808080", "silver": "#c0c0c0", "maroon": "#800000", "olive": "#808000", "purple": "#800080",
    "teal": "#008080", "navy": "#000080", "orange": "#ffa500",
}  # fmt: skip
_GROUPS = ("svg", "g", "a", "switch")
_SILENT = ("title", "desc", "metadata", "defs", "style", "namedview")


@dataclass(frozen=True, kw_only=True)
class DrawingSpec(Spec):
    """A drawing's spec."""

    modules: int = MODULES
    """modules across"""


@dataclass(frozen=True)
class _Style:
    """What shapes inherit."""

    fill: str = "black"
    rule: str = "nonzero"


def _parse(text: str, head: str, rest: str) -> DrawingSpec:
    found = _HEAD.fullmatch(head)
    if found is None:
        raise InputError(f"{head!r} is no kind of drawing; write svg:FILE.svg or svg-512:FILE.svg")
    modules = int(found["modules"] or MODULES)
    if not 1 <= modules <= MOST_MODULES:
        raise InputError(f"{text!r}: a drawing has 1 to {MOST_MODULES} modules across")
    if not rest:
        raise InputError(f"{text!r} names no file; write svg:FILE.svg")
    return DrawingSpec(text=text, kind="svg", payload=rest, modules=modules)


def _modules(spec: DrawingSpec) -> tuple[Spec, np.ndarray]:
    """Indices (h, w) uint8 into the spec's colours, the first of which is the paper's white."""
    from fidsplat.markers.shapes import filled, is_whole, modules, visible  # late, as shapely is

    root, name = _root(Path(spec.payload or "")), spec.payload
    x, y, width, height = _view(root, name)
    scale = spec.modules / width
    rows = round(height * scale)
    if not 1 <= rows <= MOST_MODULES:
        raise InputError(f"{name} would have {rows} rows of modules; 1 to {MOST_MODULES} are made")
    to_modules = np.array([[scale, 0, -x * scale], [0, scale, -y * scale], [0, 0, 1]])
    colors, shapes, points = [(1.0, 1.0, 1.0)], [], 0
    for rings, color, rule in _shapes(root, to_modules, _Style(), name):
        if color not in colors:
            colors.append(color)
        points += sum(map(len, rings))
        if len(colors) > MOST_COLORS or points > MOST_POINTS:
            raise InputError(
                f"{name} has more than {MOST_COLORS} colours or {MOST_POINTS} points: simplify the drawing"
            )
        shapes.append((filled(rings, rule), colors.index(color)))
    regions = visible(shapes, (rows, spec.modules))
    finer = None if is_whole(regions) else regions
    return replace(spec, colors=tuple(colors), regions=finer), modules(regions, (rows, spec.modules))


def _root(path: Path) -> ElementTree.Element:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} is larger than {MOST_BYTES // 1_000_000} MB: simplify the drawing")
        root = ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot read the drawing {path}: {error.strerror or error}") from error
    except ElementTree.ParseError as error:
        raise InputError(f"{path} is no SVG file: {error}") from None
    if _tag(root) != "svg":
        raise InputError(f"{path} is no SVG file: it begins with <{_tag(root)}>")
    return root


def _view(root: ElementTree.Element, name: str | None) -> tuple[float, float, float, float]:
    """The part of the plane that the drawing shows: x, y, width, height."""
    box = [float(side) for side in re.findall(_NUMBER, root.get("viewBox", ""))]
    if not box:
        sides = [re.match(_NUMBER, root.get(side, "")) for side in ("width", "height")]
        box = [0.0, 0.0, *(float(side[0]) for side in sides if side)]
    if len(box) != 4 or not (min(box[2:]) >= 1 / FARTHEST and np.abs(box).max() <= FARTHEST):
        raise InputError(
            f"{name}: it has no viewBox, nor a width and height, above 0 (and no number beyond {FARTHEST:g})"
        )
    return box[0], box[1], box[2], box[3]


def _shapes(
    element: ElementTree.Element, to_modules: np.ndarray, style: _Style, name: str | None, depth: int = 0
) -> Iterator[tuple[Rings, tuple[float, float, float], str]]:
    """Filled shapes in the order of painting: rings in modules, colour, fill rule."""
    tag = _tag(element)
    look = _look(element)
    if tag in _SILENT or look.get("display") == "none":
        return
    if depth > 100:
        raise InputError(f"{name}: groups are nested deeper than 100")
    style = _Style(look.get("fill", style.fill), look.get("fill-rule", style.rule))
    for what in ("stroke", "filter", "mask", "clip-path"):
        if look.get(what, "none") != "none":
            raise InputError(f"{name}: <{tag}> has a {what}; convert it to filled paths")
    if any(look.get(what, "1") not in ("1", "1.0", "100%") for what in ("opacity", "fill-opacity")):
        raise InputError(f"{name}: <{tag}> is translucent; a print is opaque")
    with np.errstate(all="ignore"):  # what reaches too far is refused below
        to_modules = to_modules @ _transform(element.get("transform", ""), name)
    if tag in _GROUPS:
        for child in element:
            yield from _shapes(child, to_modules, style, name, depth + 1)
        return
    rings = _rings(element, tag, name)
    if style.fill != "none":
        with np.errstate(all="ignore"):
            moved = [ring @ to_modules[:2, :2].T + to_modules[:2, 2] for ring in rings]
        if not all((np.abs(ring) <= FARTHEST).all() for ring in moved):
            raise InputError(f"{name}: <{tag}> reaches too far beyond the drawing")
        yield moved, _color(style.fill, name), style.rule


def _rings(element: ElementTree.Element, tag: str, name: str | None) -> Rings:
    def side(key: str, default: float = 0.0) -> float:
        return number(element.get(key) or str(default))

    try:
        if tag == "path":
            return path_rings(element.get("d", ""))
        if tag in ("polygon", "polyline"):
            return polygon_rings(element.get("points", ""))
        if tag == "rect" and not (side("rx") or side("ry")):
            x, y, w, h = (side(key) for key in ("x", "y", "width", "height"))
            return [np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])]
        if tag in ("circle", "ellipse"):
            rx, ry = side("rx", side("r")), side("ry", side("r"))
            return circle_rings(side("cx"), side("cy"), rx, ry)
    except ValueError as error:
        raise InputError(f"{name}: <{tag}> cannot be read: {error}") from None
    raise InputError(f"{name}: <{tag}> is no filled shape; convert it to a path")


def _look(element: ElementTree.Element) -> dict[str, str]:
    """Attributes, and over them what stands in ``style``."""
    parts = (part.partition(":") for part in element.get("style", "").split(";"))
    return dict(element.attrib) | {key.strip(): value.strip() for key, colon, value in parts if colon}


def _color(text: str, name: str | None) -> tuple[float, float, float]:
    word = _NAMED.get(text.strip().lower(), text.strip().lower())
    if re.fullmatch(r"#[0-9a-f]{3}|#[0-9a-f]{6}", word):
        digits = word[1:] if len(word) == 7 else "".join(2 * digit for digit in word[1:])
        r, g, b = (int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4))
        return r, g, b
    if found := re.fullmatch(r"rgb\(\s*(\d{1,9})[\s,]+(\d{1,9})[\s,]+(\d{1,9})\s*\)", word):
        r, g, b = (min(int(part), 255) / 255 for part in found.groups())
        return r, g, b
    raise InputError(f"{name}: the fill {text!r} is no plain colour; write #rrggbb, rgb(r, g, b) or a name")


def _transform(text: str, name: str | None) -> np.ndarray:
    matrix = np.eye(3)
    for word, inner in re.findall(r"(\w+)\s*\(([^)]*)\)", text):
        v = [float(value) for value in re.findall(_NUMBER, inner)]
        if any(abs(value) > FARTHEST for value in v):
            raise InputError(f"{name}: the transform {word}({inner}) has a number beyond {FARTHEST:g}")
        if word == "matrix" and len(v) == 6:
            step = np.array([[v[0], v[2], v[4]], [v[1], v[3], v[5]], [0, 0, 1]])
        elif word == "translate" and len(v) in (1, 2):
            step = np.array([[1, 0, v[0]], [0, 1, v[1] if len(v) == 2 else 0], [0, 0, 1]])
        elif word == "scale" and len(v) in (1, 2):
            step = np.diag([v[0], v[-1], 1.0])
        elif word == "rotate" and len(v) in (1, 3):
            c, s, (x, y) = np.cos(np.radians(v[0])), np.sin(np.radians(v[0])), v[1:] or (0.0, 0.0)
            step = np.array([[c, -s, x - c * x + s * y], [s, c, y - s * x - c * y], [0, 0, 1]])
        else:
            raise InputError(f"{name}: the transform {word}({inner}) is not understood")
        matrix = matrix @ step
    return matrix


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2] if isinstance(element.tag, str) else "title"


KINDS = (Kind("svg", "svg:FILE.svg", 0, _parse, _modules, is_file=True),)
