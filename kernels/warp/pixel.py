"""State of a sample and compositing of its fragments. Front to back, C = sum_k c_k alpha_k prod_{j<k} (1 -
alpha_j).

Fragments may be buffered until no later fragment is nearer (k_buffer.py); coplanar fragments are one layer
(coplanar.py). An external depth image is an opaque surface: fragments at or behind its depth are discarded,
and it is composited last. State of outputs is declared in their files (output/).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from . import output
from .common import MIN_ALPHA, View, fma, load_vec4, reciprocal, struct_of
from .coplanar import make_layer
from .intersection import make_intersection
from .k_buffer import make_k_buffer, make_k_buffer_struct
from .rays import make_rays
from .records import BOXES, RecordLayout
from .splat import make_splat


@cache
def make_pixel(effects: tuple[str, ...], outputs: tuple[str, ...], k_buffer_size: int) -> SimpleNamespace:
    """Make the structs Rays and Pixel, and functions of a sample: start, unfinished, blend, end (None
    without a second pass), cover (None without an opaque surface), finish; and whether blend needs no branch.
    """
    Splat, intersection = make_splat(effects, outputs).Splat, make_intersection(effects, outputs)
    Intersection, is_box = intersection.Intersection, intersection.is_box
    alpha_of, depth_of = intersection.alpha_of, intersection.depth_of
    layout = RecordLayout(effects, outputs)
    stride = layout.vec4s
    exclusive, has_depth, k_buffered, layered, has_lens = (
        name in effects for name in ("stop_exclusive", "ray_depth", "order_pixel", "order_coplanar", "rays")
    )
    boxes, has_external_depth = any(name in effects for name in BOXES), "external_depth" in effects
    rays = make_rays(has_lens, "lens_ray_length" in effects, has_lens and boxes, has_external_depth)
    Rays, length_of = rays.Rays, rays.length_of
    starts, attribute_readers, composites, covers, clears = (
        output.functions(outputs, part)
        for part in ("start", "read_attributes", "composite", "cover", "clear")
    )
    measured = bool(output.having(output.having(outputs, "start"), "length"))
    readers = [
        make_reader(layout, output.declared(name).record)
        for name in output.having(outputs, "read_attributes")
    ]
    attributes = {"rgb": wp.vec3}
    attributes |= {"z": wp.float32} if has_depth else {}
    Attributes = struct_of(
        "Attributes",
        "Attributes of a fragment or layer.",
        attributes | output.fields(outputs, "attributes"),
    )
    layer = make_layer(Attributes, effects, outputs) if layered else None
    layers_start, select, close_layers, admits, passed = (
        (layer.start, layer.select, layer.close, layer.admits, layer.passed) if layer else (None,) * 5
    )
    fields = {"t": wp.float32, "r": wp.float32, "g": wp.float32, "b": wp.float32}
    fields |= {"finished": wp.int32} if exclusive else {}
    fields |= {"opaque_z": wp.float32} if has_external_depth else {}
    fields |= output.fields(outputs, "state")
    fields |= {"k_buffer": make_k_buffer_struct(k_buffer_size)} if k_buffered else {}
    fields |= {"layers": layer.Layers} if layer else {}
    Pixel = struct_of("Pixel", "State of a sample.", fields)
    # Fragments without a contribution are then blended with weight 0 instead of skipped: without a branch,
    # the samples of a thread are executed in parallel.
    branchless = {"t", "r", "g", "b", "finished"}.issuperset(fields)

    @wp.func
    def pixel_at(x: int, y: int, number: int, view: View) -> int:
        """Index of the pixel of a sample of view `number`; pixels are numbered view after view, row by
        row."""
        row = number * (view.height / view.samples) + y / view.samples
        return row * (view.width / view.samples) + x / view.samples

    @wp.func
    def start(x: int, y: int, number: int, rays: Rays, view: View):
        """Initial state of a sample."""
        p = Pixel()
        p.t = 1.0
        if wp.static(k_buffered):
            p = k_buffer.start(p)
        if wp.static(layered):
            p.layers = layers_start()
        length = float(1.0)
        if wp.static(measured):
            length = length_of(x, y, rays, view)
        if wp.static(has_external_depth):
            p.opaque_z = wp.inf
            # tiles extend beyond the image
            if x < view.width and y < view.height:
                at = pixel_at(x, y, number, view)
                p.opaque_z = rays.external_depth[at % rays.external_depth.shape[0]]
        for k in range(wp.static(len(starts))):
            p = wp.static(starts[k])(p, length, view)
        return p

    @wp.func
    def unfinished(p: Pixel, view: View) -> bool:
        """Whether a later fragment can still contribute."""
        if wp.static(exclusive):
            return p.t > view.transmittance_stop and p.finished == 0
        elif wp.static(k_buffered):
            return p.t > view.transmittance_stop and p.k_buffer.after_z < wp.inf
        elif wp.static(layered):
            return p.t > view.transmittance_stop and p.layers.after_z < wp.inf
        else:
            return p.t > view.transmittance_stop

    @wp.func
    def attributes_at(color: wp.vec3, z: float, records: wp.array(dtype=wp.vec4), index: int):
        """Attributes of a splat's fragment at depth z."""
        attributes = Attributes()
        attributes.rgb = color
        if wp.static(has_depth):
            attributes.z = z
        for k in range(wp.static(len(attribute_readers))):
            attributes = wp.static(attribute_readers[k])(
                attributes, wp.static(readers[k])(records, index * stride), index
            )
        return attributes

    @wp.func
    def composite(pixel: Pixel, attributes: Attributes, alpha: float, view: View):
        """Composite a fragment or layer in front of all later fragments, unless the pixel is terminated."""
        p = pixel
        if wp.static(not branchless):
            if not (p.t > view.transmittance_stop):
                return p
        weight = p.t * alpha
        if wp.static(exclusive):
            # parity with gsplat and the 2DGS authors: the fragment that would terminate the pixel is dropped
            if p.t * (1.0 - alpha) <= view.transmittance_stop:
                p.finished = 1
                if wp.static(not branchless):
                    return p
                weight = 0.0
        p.r = fma(weight, attributes.rgb[0], p.r)
        p.g = fma(weight, attributes.rgb[1], p.g)
        p.b = fma(weight, attributes.rgb[2], p.b)
        for k in range(wp.static(len(composites))):
            p = wp.static(composites[k])(p, attributes, weight, view)
        p.t = p.t - weight
        return p

    @wp.func
    def stored_attributes(records: wp.array(dtype=wp.vec4), index: int, z: float):
        """Attributes of a fragment with the stored colour of its splat."""
        c = load_vec4(records, index * stride + wp.static(layout.position("r")[0]))
        return attributes_at(wp.vec3(c[1], c[2], c[3]), z, records, index)

    @wp.func
    def nearest_of(records: wp.array(dtype=wp.vec4), index: int) -> float:
        """Lower bound of the depths of a splat's fragments."""
        return load_vec4(records, index * stride + wp.static(layout.position("nearest")[0]))[
            wp.static(layout.position("nearest")[1])
        ]

    k_buffer = make_k_buffer(Pixel, composite, stored_attributes, k_buffer_size) if k_buffered else None
    end_k_buffer = k_buffer.end if k_buffer else None

    @wp.func
    def blend(
        pixel: Pixel,
        s: Splat,
        c: Intersection,
        position: int,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        coplanar_groups: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Blend a fragment of the splat at `position` in the list. The pixel is unfinished and the fragment
        contributes, unless `branchless`.
        """
        index = lists[position]
        inverse_d = float(1.0)
        if wp.static(not intersection.facing):
            inverse_d = reciprocal(c.d)
        alpha = alpha_of(s, c, inverse_d, view)
        if wp.static(branchless):
            alpha = wp.where(c.contributes and unfinished(pixel, view), alpha, 0.0)
        z, group = float(0.0), int(-1)
        if wp.static(layered):
            if pixel.layers.exist != 0:
                group = coplanar_groups[index % view.splats]
        if wp.static(has_depth):
            z = depth_of(records, index, s, c, inverse_d, group >= 0)
        if wp.static(has_external_depth):
            if not (z < pixel.opaque_z):
                return pixel
        color = wp.vec3(s.c[1], s.c[2], s.c[3])
        p = pixel
        if wp.static(layered):
            if p.layers.exist != 0:
                if not (alpha > 0.0):
                    return p  # without optical depth the mean of a layer would be 0 / 0
                p.layers = select(p.layers, group)
                if group >= 0:
                    attributes = attributes_at(color, z, records, index)
                    if wp.static(boxes):
                        if is_box(s):
                            p.layers.current = layer.accumulate_box(p.layers.current, attributes, alpha)
                            return p
                    p.layers.current = layer.accumulate(p.layers.current, attributes, alpha)
                    return p
                if not admits(p.layers, z):
                    return p
        if wp.static(k_buffered):
            return k_buffer.insert(p, nearest_of(records, index), z, alpha, position, records, lists, view)
        else:
            return composite(p, attributes_at(color, z, records, index), alpha, view)

    @wp.func
    def end(pixel: Pixel, records: wp.array(dtype=wp.vec4), lists: wp.array(dtype=wp.int32), view: View):
        """Composite the rest of this pass after the last splat of the list, and start the next pass."""
        p = pixel
        dropped = bool(False)
        if wp.static(k_buffered):
            p = end_k_buffer(p, records, lists, view)
            dropped = p.k_buffer.after_z < wp.inf
        if wp.static(layered):
            p.layers = close_layers(p.layers)
            if not dropped:
                if p.layers.next_z < wp.inf:
                    p = composite(p, p.layers.next.mean, p.layers.next.alpha, view)
                    if wp.static(k_buffered):
                        p.k_buffer.after_z = -wp.inf
                p.layers = passed(p.layers)
            p.layers.next_z = wp.inf
        return p

    @wp.func
    def cover(pixel: Pixel, x: int, y: int, number: int, rays: Rays, view: View):
        """Composite the external opaque surface with the remaining transmittance, also below the stop."""
        p = pixel
        if p.opaque_z < wp.inf:
            attributes = Attributes()
            at = pixel_at(x, y, number, view)
            attributes.rgb = rays.external_rgb[at % rays.external_rgb.shape[0]]
            attributes.z = p.opaque_z
            for k in range(wp.static(len(covers))):
                attributes = wp.static(covers[k])(attributes)
            if wp.static(exclusive):
                p.finished = 0
            unstopped = view
            unstopped.transmittance_stop = -1.0
            p = composite(p, attributes, 1.0, unstopped)
        return p

    @wp.func
    def finish(pixel: Pixel):
        """Reset depths, normals and ids of a pixel with an alpha below 1/255, after its last fragment."""
        p = pixel
        if 1.0 - p.t < MIN_ALPHA:
            for k in range(wp.static(len(clears))):
                p = wp.static(clears[k])(p)
        return p

    return SimpleNamespace(
        Rays=Rays,
        Pixel=Pixel,
        start=start,
        unfinished=unfinished,
        blend=blend,
        end=end if k_buffered or layered else None,
        cover=cover if has_external_depth else None,
        finish=finish,
        branchless=branchless,
    )


def make_reader(layout: RecordLayout, names: tuple[str, ...]):
    """Make the function (records, at) that reads these numbers of the record at line `at` as a vector."""
    places = [layout.position(name) for name in names]
    vector = wp.types.vector(max(len(names), 1), wp.float32)

    @wp.func
    def nothing(records: wp.array(dtype=wp.vec4), at: int) -> float:
        return 0.0

    @wp.func
    def read(records: wp.array(dtype=wp.vec4), at: int):
        numbers = vector()
        for k in range(wp.static(len(places))):
            numbers[k] = load_vec4(records, at + wp.static(places[k][0]))[wp.static(places[k][1])]
        return numbers

    return read if names else nothing
