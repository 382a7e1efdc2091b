"""Splats of one plane are one layer at a sample (docs/rendering.md, coplanar splats): its colour and depth
are means of its fragments by optical depth.

They arrive together, before anything that the layer is compared with; it is laid before the first fragment of
no plane that lies behind it there, or at the end. Two layers may be pending; when a third begins the nearer
of them is laid.
"""

from types import SimpleNamespace

import warp as wp

from .common import View, fma, struct_of
from .fast import fast_log

FAINT = wp.constant(1e-3)
"""below it the optical depth of an opacity a is a + a^2 / 2, to 3 parts in 10^7"""
DARKEST = wp.constant(wp.float32(2.0**-24))
"""transmittance of an opaque fragment, whose optical depth would be infinite"""


def make_layer(Seen, effects: tuple[str, ...]) -> SimpleNamespace:
    """Layer, and what is known of it: gather, gather_box; nothing, depth, shown."""
    normal, heaviest, blended = (name in effects for name in ("normal", "heaviest", "blended"))
    log = fast_log if "arithmetic_fast" in effects else wp.log
    # `mean` holds sums over the layer's fragments, each times its optical depth; of boxes, times its opacity
    fields = {"plane": wp.int32, "opacity": wp.float32, "ink": wp.float32, "mean": Seen}
    fields |= {"thickest": wp.float32} if heaviest else {}
    Layer = struct_of("Layer", "What a sample sees of one plane; plane -1: nothing.", fields)

    @wp.func
    def nothing():
        layer = Layer()
        layer.plane = -1
        return layer

    @wp.func
    def depth(layer: Layer) -> float:
        return layer.mean.z / layer.ink

    @wp.func
    def shown(layer: Layer):
        """What the layer shows as one thing."""
        seen = layer.mean
        seen.rgb = layer.mean.rgb / layer.ink
        seen.z = depth(layer)
        if wp.static(normal):
            seen.normal = layer.mean.normal / layer.ink
        return seen

    @wp.func
    def gather(layer: Layer, plane: int, seen: Seen, opacity: float):
        """The layer with one more fragment: optical depths -ln(1 - opacity) add up."""
        tau = opacity + 0.5 * opacity * opacity  # of a faint one, which 1 - opacity would blur
        if opacity > FAINT:
            # an opaque fragment has the optical depth at which float32 leaves no light
            tau = -log(wp.max(1.0 - opacity, DARKEST))
        after = mixed_in(layer, plane, seen, tau)
        after.opacity = fma(opacity, 1.0 - layer.opacity, layer.opacity)
        return after

    @wp.func
    def gather_box(layer: Layer, plane: int, seen: Seen, opacity: float):
        """The layer with one more box: they lie side by side, so what they cover adds up."""
        after = mixed_in(layer, plane, seen, opacity)
        after.opacity = wp.min(after.ink, 1.0)
        return after

    @wp.func
    def mixed_in(layer: Layer, plane: int, seen: Seen, tau: float):
        """The layer with more ink, tau, that shows `seen`."""
        after = layer
        after.plane = plane
        after.ink = layer.ink + tau
        mean = layer.mean
        mean.rgb = layer.mean.rgb + tau * seen.rgb
        mean.z = fma(tau, seen.z, layer.mean.z)
        if wp.static(normal):
            mean.normal = layer.mean.normal + tau * seen.normal
        if wp.static(heaviest):
            if tau > layer.thickest:
                after.thickest = tau
                mean.heaviest = seen.heaviest
        if wp.static(blended):
            mean.blended = layer.mean.blended + seen.blended
        after.mean = mean
        return after

    return SimpleNamespace(
        Layer=Layer, nothing=nothing, depth=depth, shown=shown, gather=gather, gather_box=gather_box
    )


def make_laying(layer: SimpleNamespace, Pixel, lay) -> SimpleNamespace:
    """lay_before and begin: when the pending layers `open` and `waiting` of a Pixel are laid by `lay`."""
    nothing, depth, shown = layer.nothing, layer.depth, layer.shown

    @wp.func
    def lay_before(pixel: Pixel, z: float, view: View):
        """The pixel with its pending layers laid that lie before depth z, the nearer first."""
        p = pixel
        for turn in range(2):
            has_open = bool(False)
            has_waiting = bool(False)
            if p.open.plane >= 0:
                has_open = depth(p.open) < z
            if p.waiting.plane >= 0:
                has_waiting = depth(p.waiting) < z
            if has_open and has_waiting:
                # of equals the one that arrived first
                if depth(p.open) < depth(p.waiting):
                    has_waiting = False
                else:
                    has_open = False
            if has_waiting:
                p = lay(p, shown(p.waiting), p.waiting.opacity, view)
                p.waiting = nothing()
            if has_open:
                p = lay(p, shown(p.open), p.open.opacity, view)
                p.open = nothing()
        return p

    @wp.func
    def begin(pixel: Pixel, view: View):
        """The pixel with no open layer: it waits, and of two that would wait the nearer is laid."""
        p = pixel
        if p.waiting.plane >= 0:
            if depth(p.open) < depth(p.waiting):
                p = lay(p, shown(p.open), p.open.opacity, view)
                p.open = nothing()
                return p
            p = lay(p, shown(p.waiting), p.waiting.opacity, view)
        p.waiting = p.open
        p.open = nothing()
        return p

    return SimpleNamespace(lay_before=lay_before, begin=begin)
