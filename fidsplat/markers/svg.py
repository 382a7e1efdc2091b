"""SVG drawings: the filled shapes of a file with their colours, as polygons with holes.

The splats cover the polygons; `Marker.bits` has the topmost shape at the centre of each module. Only shapes
with a plain fill are supported; everything else (text, strokes, gradients, images) is an error, so that a
marker never differs from its drawing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from fidsplat.markers.paths import (
    FARTHEST,
    Rings,
    circle_rings,
    number,
    path_rings,
    polygon_rings,
    rectangle_rings,
)
from fidsplat.markers.spec import Kind, Spec
from fidsplat.markers.styles import COLORS, Rule, rules, styled
from fidsplat.util.errors import InputError
from fidsplat.util.files import read_input

MODULES = 256
"""Default number of modules across a drawing."""

MAX_MODULES, MAX_BYTES, MAX_COLORS, MAX_POINTS = 2048, 2_000_000, 64, 200_000

_HEAD = re.compile(r"svg(?:-(?P<modules>[0-9]{1,5}))?", re.IGNORECASE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_GROUPS = ("svg", "g", "a", "switch")
_SILENT = ("title", "desc", "metadata", "defs", "style", "namedview")
_REFUSED = ("stroke", "filter", "mask", "clip-path", "mix-blend-mode")
_PLACES = ("x", "y", "width", "height", "viewBox")
# geometry properties, which are supported only as attributes
_OF_SHAPES = ("d", "x", "y", "width", "height", "r", "rx", "ry", "cx", "cy")
_MOVES = ("transform", "transform-origin", "translate", "rotate", "scale")


@dataclass(frozen=True, kw_only=True)
class DrawingSpec(Spec):
    modules: int = MODULES
    """modules across"""


@dataclass(frozen=True)
class _Style:
    """Style properties that shapes inherit."""

    fill: str = "black"
    rule: str = "nonzero"
    visibility: str = "visible"
    color: str = "black"


class _File(NamedTuple):
    """Context shared by all elements of a drawing."""

    name: str | None
    sheet: list[Rule]


def _parse(text: str, head: str, rest: str) -> DrawingSpec:
    match = _HEAD.fullmatch(head)
    if match is None:
        raise InputError(f"a drawing must be svg:FILE.svg or svg-512:FILE.svg, got {head!r}")
    modules = int(match["modules"] or MODULES)
    if not 1 <= modules <= MAX_MODULES:
        raise InputError(f"a drawing must have 1 to {MAX_MODULES} modules across, got {text!r}")
    if not rest:
        raise InputError(f"the spec of a drawing must be svg:FILE.svg, got {text!r}")
    return DrawingSpec(text=text, kind="svg", payload=rest, modules=modules)


def _modules(spec: DrawingSpec) -> tuple[Spec, np.ndarray]:
    """Modules (h, w) uint8 of a drawing: indices of the spec's colours, of which the first is white."""
    from fidsplat.markers.shapes import (
        filled,
        is_whole,
        modules,
        refuse_tangles,
        visible,
    )  # here, since it imports shapely

    root, name = _root(Path(spec.payload or "")), spec.payload
    x, y, width, height = _view(root, name)
    scale = spec.modules / width
    rows = round(height * scale)
    if not 1 <= rows <= MAX_MODULES:
        raise InputError(f"{name} must have 1 to {MAX_MODULES} rows of modules, got {rows}")
    to_modules = np.array([[scale, 0, -x * scale], [0, scale, -y * scale], [0, 0, 1]])
    colors, points = [(1.0, 1.0, 1.0)], 0
    outlines: list[tuple[Rings, str, int]] = []
    for rings, color, rule in _shapes(root, to_modules, _Style(), _File(name, _sheet(root, name))):
        if color not in colors:
            colors.append(color)
        points += sum(map(len, rings))
        if len(colors) > MAX_COLORS or points > MAX_POINTS:
            raise InputError(
                f"{name} must have at most {MAX_COLORS} colours and {MAX_POINTS} points, got more; simplify "
                "the drawing"
            )
        outlines.append((rings, rule, colors.index(color)))
    refuse_tangles([ring for rings, _, _ in outlines for ring in rings], name)
    shapes = [(filled(rings, rule), value) for rings, rule, value in outlines]
    regions = visible(shapes, (rows, spec.modules))
    finer = None if is_whole(regions) else regions
    return replace(spec, colors=tuple(colors), regions=finer), modules(regions, (rows, spec.modules))


def _root(path: Path) -> ElementTree.Element:
    try:
        root = ElementTree.fromstring(read_input(path, MAX_BYTES))
    except ElementTree.ParseError as error:
        raise InputError(f"cannot read {path} as SVG: {error}; export it again as SVG") from None
    if _tag(root) != "svg":
        raise InputError(f"cannot read {path} as SVG: it begins with <{_tag(root)}>; export it as SVG")
    return root


def _view(root: ElementTree.Element, name: str | None) -> tuple[float, float, float, float]:
    """View box: x, y, width, height."""
    box = [float(side) for side in re.findall(_NUMBER, root.get("viewBox", ""))]
    if not box:
        sides = [re.match(_NUMBER, root.get(side, "")) for side in ("width", "height")]
        box = [0.0, 0.0, *(float(side[0]) for side in sides if side)]
    if len(box) != 4 or not (min(box[2:]) >= 1 / FARTHEST and np.abs(box).max() <= FARTHEST):
        raise InputError(
            f"{name} must have a viewBox, or width and height, with sides from {1 / FARTHEST:g} to "
            f"{FARTHEST:g} and a corner within {FARTHEST:g} of 0, got "
            f"{' '.join(f'{side:g}' for side in box) if len(box) > 2 else 'none'}; "
            "set viewBox='0 0 WIDTH HEIGHT'"
        )
    return box[0], box[1], box[2], box[3]


def _sheet(root: ElementTree.Element, name: str | None) -> list[Rule]:
    """Rules of the style sheets of a document."""
    text = "".join("".join(element.itertext()) for element in root.iter() if _tag(element) == "style")
    try:
        return rules(text)
    except ValueError as error:
        raise InputError(
            f"{name}: its style sheet must only have rules for .class, #id and tags, got {error}"
        ) from None


def _shapes(
    element: ElementTree.Element, to_modules: np.ndarray, style: _Style, file: _File, depth: int = 0
) -> Iterator[tuple[Rings, tuple[float, float, float], str]]:
    """Filled shapes in the order of painting: rings in modules, colour, fill rule."""
    tag, name = _tag(element), file.name
    if tag in _SILENT:
        return
    look = _look(element, tag, file)
    if look.get("display") == "none":
        return
    if depth > 100:
        raise InputError(f"{name}: groups must be nested at most 100 deep, got more; flatten them")
    if tag == "svg" and depth and any(key in element.attrib for key in _PLACES):
        raise InputError(
            f"{name}: an <svg> must be the outermost element, got one in another; make it a group"
        )
    for what in _REFUSED:
        if look.get(what, "none") not in ("none", "normal"):
            raise InputError(f"{name}: <{tag}> must be filled paths, got a {what}; convert it")
    for what in ("opacity", "fill-opacity"):
        if not _is_one(look.get(what, "1")):
            raise InputError(f"{name}: <{tag}> must be opaque, got {what} {look[what]}; remove it")
    style = _inherited(style, look)
    with np.errstate(all="ignore"):  # checked below
        to_modules = to_modules @ _transform(element.get("transform", ""), name)
    if tag in _GROUPS:
        for child in _first(element) if tag == "switch" else element:
            yield from _shapes(child, to_modules, style, file, depth + 1)
        return
    rings = _rings(element, tag, name)
    if style.fill not in ("none", "transparent") and style.visibility == "visible":
        with np.errstate(all="ignore"):
            moved = [ring @ to_modules[:2, :2].T + to_modules[:2, 2] for ring in rings]
        if not all((np.abs(ring) <= FARTHEST).all() for ring in moved):
            farthest = max(float(np.abs(ring).max(initial=0)) for ring in moved)
            raise InputError(
                f"{name}: the coordinates of <{tag}> must be at most {FARTHEST:g} modules, got {farthest:g}; "
                "move the shape closer to the viewBox"
            )
        yield moved, _color(style.color if style.fill == "currentColor" else style.fill, name), style.rule


def _inherited(style: _Style, look: dict[str, str]) -> _Style:
    names = {"fill": "fill", "rule": "fill-rule", "visibility": "visibility", "color": "color"}
    values = {field.name: look.get(names[field.name], "inherit") for field in fields(style)}
    return replace(style, **{key: value for key, value in values.items() if value != "inherit"})


def _first(switch: ElementTree.Element) -> list[ElementTree.Element]:
    """The rendered child of a <switch>: the first without a required extension or language."""
    asks = ("requiredExtensions", "systemLanguage")
    free = (
        child
        for child in switch
        if _tag(child) not in _SILENT and not any(key in child.attrib for key in asks)
    )
    return [child for child, _ in zip(free, range(1), strict=False)]


def _rings(element: ElementTree.Element, tag: str, name: str | None) -> Rings:
    def side(key: str, default: float = 0.0) -> float:
        return number(element.get(key) or str(default))

    try:
        if tag == "path":
            return path_rings(element.get("d", ""))
        if tag in ("polygon", "polyline"):
            return polygon_rings(element.get("points", ""))
        if tag == "rect":
            rx, ry = side("rx", side("ry")), side("ry", side("rx"))
            return rectangle_rings(side("x"), side("y"), side("width"), side("height"), rx, ry)
        if tag in ("circle", "ellipse"):
            rx, ry = side("rx", side("r")), side("ry", side("r"))
            return circle_rings(side("cx"), side("cy"), rx, ry)
    except ValueError as error:
        raise InputError(f"{name}: cannot read <{tag}>: {error}") from None
    raise InputError(f"{name} must have filled shapes, got <{tag}>; convert it to a path")


def _look(element: ElementTree.Element, tag: str, file: _File) -> dict[str, str]:
    """Attributes of an element, overridden by style sheets and `style`."""
    try:
        attributes = styled(file.sheet, tag, element.attrib)
    except ValueError as error:
        raise InputError(f"{file.name}: the style of <{tag}> must be plain properties, got {error}") from None
    for key in (*_MOVES, *(() if tag in _GROUPS else _OF_SHAPES)):
        if key in attributes or (key == "transform-origin" and key in element.attrib):
            raise InputError(f"{file.name}: {key} of <{tag}> must be an attribute, got a style property")
    return element.attrib | attributes


def _is_one(text: str) -> bool:
    try:
        return float(text.removesuffix("%")) == (100 if text.endswith("%") else 1)
    except ValueError:
        return False


def _color(text: str, name: str | None) -> tuple[float, float, float]:
    word = text.strip().lower()
    word = f"#{COLORS[word]}" if word in COLORS else word
    if re.fullmatch(r"#[0-9a-f]{3}|#[0-9a-f]{6}", word):
        digits = word[1:] if len(word) == 7 else "".join(2 * digit for digit in word[1:])
        r, g, b = (int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4))
        return r, g, b
    if match := re.fullmatch(r"rgb\(\s*(\d{1,9})[\s,]+(\d{1,9})[\s,]+(\d{1,9})\s*\)", word):
        r, g, b = (min(int(part), 255) / 255 for part in match.groups())
        return r, g, b
    raise InputError(f"{name}: a fill must be #rrggbb, rgb(r, g, b) or a name, got {text!r}")


def _transform(text: str, name: str | None) -> np.ndarray:
    matrix = np.eye(3)
    left = re.sub(r"\w+\s*\([^)]*\)|[\s,]", "", text)
    if left:
        raise InputError(f"{name}: cannot parse the transform {text[:40]!r}")
    for word, inner in re.findall(r"(\w+)\s*\(([^)]*)\)", text):
        v = [float(value) for value in re.findall(_NUMBER, inner)]
        if any(abs(value) > FARTHEST for value in v):
            raise InputError(
                f"{name}: numbers of a transform must be at most {FARTHEST:g}, got {word}({inner})"
            )
        plain = not re.sub(r"[\s,]", "", re.sub(_NUMBER, "", inner))
        if word == "matrix" and len(v) == 6 and plain:
            step = np.array([[v[0], v[2], v[4]], [v[1], v[3], v[5]], [0, 0, 1]])
        elif word == "translate" and len(v) in (1, 2) and plain:
            step = np.array([[1, 0, v[0]], [0, 1, v[1] if len(v) == 2 else 0], [0, 0, 1]])
        elif word == "scale" and len(v) in (1, 2) and plain:
            step = np.diag([v[0], v[-1], 1.0])
        elif word == "rotate" and len(v) in (1, 3) and plain:
            c, s, (x, y) = np.cos(np.radians(v[0])), np.sin(np.radians(v[0])), v[1:] or (0.0, 0.0)
            step = np.array([[c, -s, x - c * x + s * y], [s, c, y - s * x - c * y], [0, 0, 1]])
        elif word in ("skewX", "skewY") and len(v) == 1 and plain:
            step, at = np.eye(3), (0, 1) if word == "skewX" else (1, 0)
            step[at] = np.tan(np.radians(v[0]))
        else:
            raise InputError(f"{name}: cannot parse the transform {word}({inner})")
        matrix = matrix @ step
    return matrix


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2] if isinstance(element.tag, str) else "title"


KINDS = (Kind("svg", "svg:FILE.svg", 0, _parse, _modules, is_file=True),)
