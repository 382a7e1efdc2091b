"""Splats of one plane are one layer at a sample (docs/correctness.md): its colour and depth are means of its
fragments by optical depth.

They stand together in the lists, where the nearest point of the plane puts them; when another splat follows,
the layer waits as one fragment among the others (k_buffer.py).
"""

from types import SimpleNamespace

import warp as wp

from . import output
from .common import fma, fma3, struct_of
from .fast import fast_log

DARKEST = wp.constant(wp.float32(2.0**-24))
"""transmittance of an opaque fragment, whose optical depth would be infinite"""


NEARER = wp.constant(wp.float32(-(2.0**-16)))
"""relative depth by which a layer counts as nearer than ungrouped splats in its plane"""


def make_layer(Attributes, effects: tuple[str, ...], outputs: tuple[str, ...]) -> SimpleNamespace:
    """The struct Layer and its functions: accumulate, accumulate_box; nothing, depth."""
    log = fast_log if "arithmetic_fast" in effects else wp.log
    accumulators = output.functions(outputs, "accumulate")
    # tau: optical depth; `mean`: weighted by optical depths; of boxes, by opacities
    # place: of the first splat in the list; nearest: lower bound of the depths
    fields = {
        "plane": wp.int32,
        "place": wp.int32,
        "nearest": wp.float32,
        "opacity": wp.float32,
        "tau": wp.float32,
        "mean": Attributes,
    }
    fields |= output.fields(outputs, "layer")
    Layer = struct_of("Layer", "Fragments of one coplanar group at a sample; plane -1: none.", fields)

    @wp.func
    def empty_layer(plane: int, place: int, nearest: float):
        """The layer of a plane before its first fragment, the splat at this place of the list."""
        layer = Layer()
        layer.plane = plane
        layer.place = place
        layer.nearest = nearest
        return layer

    @wp.func
    def nothing():
        return empty_layer(-1, 0, 0.0)

    @wp.func
    def depth(layer: Layer) -> float:
        """Sort depth of the layer, nearer by slightly more than the rounding of depths, so that it is in
        front of ungrouped splats in its plane.
        """
        z = layer.mean.z
        return wp.max(fma(wp.abs(z), NEARER, z), layer.nearest)

    @wp.func
    def accumulate(layer: Layer, attributes: Attributes, opacity: float):
        """The layer with one more fragment: optical depths -ln(1 - opacity) add up."""
        # an opaque fragment has the optical depth at which float32 leaves no light
        tau = -log(wp.max(1.0 - opacity, DARKEST))
        after = with_fragment(layer, attributes, tau)
        after.opacity = fma(opacity, 1.0 - layer.opacity, layer.opacity)
        return after

    @wp.func
    def accumulate_box(layer: Layer, attributes: Attributes, opacity: float):
        """The layer with one more box: they lie side by side, so what they cover adds up."""
        after = with_fragment(layer, attributes, opacity)
        after.opacity = wp.min(after.tau, 1.0)
        return after

    @wp.func
    def with_fragment(layer: Layer, attributes: Attributes, tau: float):
        """The layer with a fragment of optical depth tau that shows `attributes`."""
        after = layer
        after.tau = layer.tau + tau
        share = float(0.0)
        if tau > 0.0:
            share = tau / after.tau
        after.mean.rgb = fma3(share, attributes.rgb - layer.mean.rgb, layer.mean.rgb)
        after.mean.z = fma(share, attributes.z - layer.mean.z, layer.mean.z)
        for k in range(wp.static(len(accumulators))):
            after = wp.static(accumulators[k])(after, attributes, tau, share)
        return after

    return SimpleNamespace(
        Layer=Layer,
        nothing=nothing,
        empty_layer=empty_layer,
        depth=depth,
        accumulate=accumulate,
        accumulate_box=accumulate_box,
    )
