"""Splats of one plane are one layer at a sample (docs/order.md): its colour and depth
are means of its fragments by optical depth.

They arrive together, before anything that the layer is compared with; it is composited before the first
fragment of no plane that lies behind it there, or at the end. Two layers may be pending; when a third begins
the nearer of them is composited.
"""

from types import SimpleNamespace

import warp as wp

from . import output
from .common import View, fma, struct_of
from .fast import fast_log

FAINT = wp.constant(1e-3)
"""below it the optical depth of an opacity a is a + a^2 / 2, to 3 parts in 10^7"""
DARKEST = wp.constant(wp.float32(2.0**-24))
"""transmittance of an opaque fragment, whose optical depth would be infinite"""


def make_layer(Seen, effects: tuple[str, ...], outputs: tuple[str, ...]) -> SimpleNamespace:
    """Layer, and what is known of it: gather, gather_box; nothing, depth, shown."""
    log = fast_log if "arithmetic_fast" in effects else wp.log
    gathers, averages = (output.functions(outputs, part) for part in ("gather", "average"))
    # tau: optical depth; `mean`: sums over fragments, each times its optical depth; of boxes, its opacity
    fields = {"plane": wp.int32, "opacity": wp.float32, "tau": wp.float32, "mean": Seen}
    fields |= output.fields(outputs, "layer")
    Layer = struct_of("Layer", "What a sample sees of one plane; plane -1: nothing.", fields)

    @wp.func
    def nothing():
        layer = Layer()
        layer.plane = -1
        return layer

    @wp.func
    def depth(layer: Layer) -> float:
        return layer.mean.z / layer.tau

    @wp.func
    def shown(layer: Layer):
        """What the layer shows as one thing."""
        seen = layer.mean
        seen.rgb = layer.mean.rgb / layer.tau
        seen.z = depth(layer)
        for k in range(wp.static(len(averages))):
            seen = wp.static(averages[k])(seen, layer.tau)
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
        after.opacity = wp.min(after.tau, 1.0)
        return after

    @wp.func
    def mixed_in(layer: Layer, plane: int, seen: Seen, tau: float):
        """The layer with a fragment of optical depth tau that shows `seen`."""
        after = layer
        after.plane = plane
        after.tau = layer.tau + tau
        after.mean.rgb = layer.mean.rgb + tau * seen.rgb
        after.mean.z = fma(tau, seen.z, layer.mean.z)
        for k in range(wp.static(len(gathers))):
            after = wp.static(gathers[k])(after, seen, tau)
        return after

    return SimpleNamespace(
        Layer=Layer, nothing=nothing, depth=depth, shown=shown, gather=gather, gather_box=gather_box
    )


def make_pending(layer: SimpleNamespace, Pixel, composite) -> SimpleNamespace:
    """composite_before and begin: when the pending layers `open` and `waiting` of a Pixel are composited."""
    nothing, depth, shown = layer.nothing, layer.depth, layer.shown

    @wp.func
    def composite_before(pixel: Pixel, z: float, view: View):
        """The pixel with its pending layers composited that lie before depth z, the nearer first."""
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
                p = composite(p, shown(p.waiting), p.waiting.opacity, view)
                p.waiting = nothing()
            if has_open:
                p = composite(p, shown(p.open), p.open.opacity, view)
                p.open = nothing()
        return p

    @wp.func
    def begin(pixel: Pixel, view: View):
        """The pixel with no open layer: it waits, and of two that would wait the nearer is composited."""
        p = pixel
        if p.waiting.plane >= 0:
            if depth(p.open) < depth(p.waiting):
                p = composite(p, shown(p.open), p.open.opacity, view)
                p.open = nothing()
                return p
            p = composite(p, shown(p.waiting), p.waiting.opacity, view)
        p.waiting = p.open
        p.open = nothing()
        return p

    return SimpleNamespace(composite_before=composite_before, begin=begin)
