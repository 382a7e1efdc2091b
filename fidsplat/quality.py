"""Every knob that trades accuracy for time, and the named presets.

A `Quality` says what is computed, never where: the same object works on every backend.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, fields, replace

from fidsplat.errors import InputError

LOWPASS = ("screen", "pixel", "none")
STOP_RULES = ("inclusive", "exclusive")
COPLANAR = ("blend", "order")
SETUP_PRECISIONS = ("float64", "float32")
MAX_SAMPLES = 8


@dataclass(frozen=True)
class Quality:
    """Knobs of one rendering.

    Raises:
        InputError: a value lies outside its range; the message names the range.
    """

    alpha_cutoff: float = 1.0 / 255.0
    """Contributions below this alpha are not drawn, (0, 1). It sets each splat's radius:
    R^2 = 2 ln(opacity / cutoff), the same R in bounds and in the per-pixel test. Lower costs area, higher
    bites haze (research: 100 layers of alpha 0.0039 lose 32 % opacity at 1/255)."""

    transmittance_stop: float = 1e-4
    """A pixel is finished once its transmittance is at or below this, [0, 1). 0 never stops."""

    stop_rule: str = "inclusive"
    """`inclusive`: the fragment that reaches the stop is still drawn. `exclusive` (gsplat, 2DGS authors): it
    is dropped, which leaks up to 1 % of the background through opaque splats; kept for parity only."""

    opacity_ceiling: float = 1.0
    """Upper bound of one fragment's alpha, (0, 1]. gsplat and the 2DGS authors use 0.99."""

    lowpass: str = "screen"
    """`screen`: the object-space low-pass of 2DGS (a Gaussian of sigma 0.707 px around the projected centre,
    the larger of the two weights wins); for scenes that were trained with it, as 2DGS scenes are. `pixel`:
    each splat convolved in its plane with a Gaussian of a sample's footprint (sigma 0.5 samples), its opacity
    scaled by the ratio of the areas, so that it conserves energy; for splats far below a pixel. `none`: the
    exact splat; for markers of Gaussians, with several samples per pixel. Boxes filter themselves."""

    coplanar: str = "blend"
    """Splats that are printed on one plane (markers). `blend`: one layer whose colour does not depend on
    their order, placed by its own depth at each pixel. `order`: by the depth of their centres, as any other
    splats, which flips as the camera turns."""

    samples: int = 1
    """n: each pixel is the mean of n x n samples on a regular grid, 1 to 8."""

    first_hit: float = 0.1
    """Opacity at which the outputs depth_first and distance_first see a surface, (0, 1): the first fragment
    or layer behind which the transmittance is at most 1 less this."""

    setup_precision: str = "float64"
    """Arithmetic of the per-splat set-up. `float32` is also what a device without float64 uses."""

    def __post_init__(self) -> None:
        def within(name: str, low: float, high: float, low_open: bool, high_open: bool) -> None:
            value = getattr(self, name)
            ok = (
                isinstance(value, (int, float))
                and math.isfinite(value)
                and (value > low if low_open else value >= low)
                and (value < high if high_open else value <= high)
            )
            if not ok:
                left, right = "(" if low_open else "[", ")" if high_open else "]"
                raise InputError(
                    f"quality: {name} is {value!r}; it must lie in {left}{low:g}, {high:g}{right}"
                )

        within("alpha_cutoff", 0.0, 1.0, True, True)
        within("transmittance_stop", 0.0, 1.0, False, True)
        within("opacity_ceiling", 0.0, 1.0, True, False)
        within("first_hit", 0.0, 1.0, True, True)
        for name, known in (
            ("stop_rule", STOP_RULES),
            ("lowpass", LOWPASS),
            ("coplanar", COPLANAR),
            ("setup_precision", SETUP_PRECISIONS),
        ):
            if getattr(self, name) not in known:
                raise InputError(f"quality: {name} is {getattr(self, name)!r}; known: {', '.join(known)}")
        if self.stop_rule == "exclusive" and self.coplanar == "blend":
            raise InputError(
                "quality: the exclusive stop drops single fragments, which coplanar='blend' does not have; "
                "use coplanar='order' with it"
            )
        if not isinstance(self.samples, int) or not 1 <= self.samples <= MAX_SAMPLES:
            raise InputError(
                f"quality: samples is {self.samples!r}; it must be a whole number from 1 to {MAX_SAMPLES}"
            )

    @classmethod
    def named(cls, name: str) -> Quality:
        """The preset of that name: standard, fast, reference, gsplat or surfel."""
        if name in PRESETS:
            return PRESETS[name]
        near = difflib.get_close_matches(str(name), PRESETS, 1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        raise InputError(f"unknown quality {name!r}{hint}; known: {', '.join(PRESETS)}")

    @classmethod
    def of(cls, quality: Quality | str | None) -> Quality:
        """A `Quality` from itself, from a preset's name, or the default from None."""
        if quality is None:
            return PRESETS["standard"]
        if isinstance(quality, cls):
            return quality
        return cls.named(quality)  # type: ignore[arg-type]

    def with_(self, **changes) -> Quality:
        """A copy with some knobs changed; an unknown knob is an error that names the known ones."""
        known = [f.name for f in fields(self)]
        for name in changes:
            if name not in known:
                raise InputError(f"quality has no knob {name!r}; known: {', '.join(known)}")
        return replace(self, **changes)


# gsplat: gsplat 1.5/1.6 `rasterization_2dgs`; surfel: the 2DGS authors' diff-surfel-rasterization.
# Both clamp alpha at 0.99, cut at 1/255 and drop the fragment that would take T below 1e-4. What differs
# between them (bounding boxes, low-pass centre, near plane) is a defect of theirs, not a constant: see
# docs/conventions.md.
_PARITY = Quality(opacity_ceiling=0.99, stop_rule="exclusive", coplanar="order")

PRESETS: dict[str, Quality] = {
    "standard": Quality(),
    "fast": Quality(alpha_cutoff=2.0 / 255.0, transmittance_stop=1.0 / 256.0, setup_precision="float32"),
    "reference": Quality(alpha_cutoff=1e-6, transmittance_stop=0.0),
    "gsplat": _PARITY,
    "surfel": _PARITY,
}
