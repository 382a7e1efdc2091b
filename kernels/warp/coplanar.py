"""Coplanar groups as layers (docs/correctness.md): the colour and depth of a layer are means of its
fragments, weighted by optical depth.

Splats of groups are the first splats of a tile's list, group after group. A pass over the list finds the
nearest layer behind that of the previous pass, composites the fragments of other splats between the two, then
the layer.
"""

from types import SimpleNamespace

import warp as wp

from . import output
from .common import fma, fma3, struct_of
from .fast import fast_log

FAINT_ALPHA = wp.constant(1e-3)
"""alpha below which the optical depth is computed by a series (to 3e-7), as 1 - alpha is rounded"""
MIN_TRANSMITTANCE = wp.constant(wp.float32(2.0**-24))
"""minimum transmittance, so that the optical depth of an opaque fragment is finite"""


DEPTH_BIAS = wp.constant(wp.float32(-(2.0**-16)))
"""relative depth bias that sorts a layer in front of ungrouped splats in its plane"""


def make_layer(Attributes, effects: tuple[str, ...], outputs: tuple[str, ...]) -> SimpleNamespace:
    """Make the structs Layer and Layers, and their functions: accumulate, accumulate_box; start, select,
    close, admits, passed.
    """
    log = fast_log if "arithmetic_fast" in effects else wp.log
    accumulators = output.functions(outputs, "accumulate")
    # tau: optical depth; mean: weighted by optical depths, for boxes by opacities
    fields = {
        "group": wp.int32,
        "alpha": wp.float32,
        "tau": wp.float32,
        "mean": Attributes,
    }
    fields |= output.fields(outputs, "layer")
    Layer = struct_of("Layer", "Fragments of one coplanar group at a sample; group -1: none.", fields)
    # exist: whether the tile has groups; current: the layer that still accumulates; next: the nearest layer
    # of this pass, with an infinite depth if there is none; after: depth and group of the layer of the
    # previous pass
    passing = {
        "exist": wp.int32,
        "current": Layer,
        "next": Layer,
        "next_z": wp.float32,
        "after_z": wp.float32,
        "after_group": wp.int32,
    }
    Layers = struct_of("Layers", "Layers of a sample.", passing)

    @wp.func
    def empty_layer(group: int):
        layer = Layer()
        layer.group = group
        return layer

    @wp.func
    def start():
        """State before the first pass, in a tile without groups."""
        layers = Layers()
        layers.current = empty_layer(-1)
        layers.next_z = wp.inf
        layers.after_z = -wp.inf
        layers.after_group = -1
        return layers

    @wp.func
    def depth(layer: Layer) -> float:
        """Sort depth of the layer, biased by slightly more than the rounding of depths, so that the layer is
        in front of ungrouped splats in its plane.
        """
        z = layer.mean.z
        return fma(wp.abs(z), DEPTH_BIAS, z)

    @wp.func
    def close(layers: Layers):
        """Complete the current layer, and store it if it is the nearest of this pass."""
        after = layers
        if layers.current.tau > 0.0:
            z = depth(layers.current)
            follows = z > layers.after_z or (
                z == layers.after_z and layers.current.group > layers.after_group
            )
            if follows and z < layers.next_z:
                after.next = layers.current
                after.next_z = z
        after.current = empty_layer(-1)
        return after

    @wp.func
    def select(layers: Layers, group: int):
        """Open the layer of the current splat's group; group -1: no layer."""
        if group == layers.current.group:
            return layers
        after = close(layers)
        after.current = empty_layer(group)
        return after

    @wp.func
    def admits(layers: Layers, z: float) -> bool:
        """Whether a fragment of a splat without group belongs to this pass."""
        return z >= layers.after_z and z < layers.next_z

    @wp.func
    def passed(layers: Layers):
        """State before the next pass, at an infinite depth after the last pass."""
        after = layers
        after.after_z = layers.next_z
        after.after_group = layers.next.group
        after.next_z = wp.inf
        return after

    @wp.func
    def accumulate(layer: Layer, attributes: Attributes, alpha: float):
        """Add a fragment to a layer: optical depths -ln(1 - alpha) add up."""
        # an opaque fragment has the optical depth at which float32 transmittance is 0
        tau = -log(wp.max(1.0 - alpha, MIN_TRANSMITTANCE))
        if alpha < FAINT_ALPHA:
            tau = fma(0.5 * alpha, alpha, alpha)
        after = with_fragment(layer, attributes, tau)
        after.alpha = fma(alpha, 1.0 - layer.alpha, layer.alpha)
        return after

    @wp.func
    def accumulate_box(layer: Layer, attributes: Attributes, alpha: float):
        """Add a box to a layer: boxes do not overlap, so that their alphas add up."""
        after = with_fragment(layer, attributes, alpha)
        after.alpha = wp.min(after.tau, 1.0)
        return after

    @wp.func
    def with_fragment(layer: Layer, attributes: Attributes, tau: float):
        """Add a fragment with optical depth tau and `attributes` to a layer."""
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
        Layers=Layers,
        accumulate=accumulate,
        accumulate_box=accumulate_box,
        start=start,
        select=select,
        close=close,
        admits=admits,
        passed=passed,
    )
