"""Projection of splats: culling, image bounds, sort keys and records."""

import math
from functools import cache

import warp as wp

from . import output
from .bounds import PAD, PAD_RELATIVE, Bounds, box_bounds, make_bounds
from .boxes import make_boxes
from .color import make_color
from .common import CULLED, STRICT, View, as_bits, divide, reread, sortable, store_vec4
from .disk import make_disk
from .ellipsoids import EWA, EXACT, make_ellipsoids
from .fast import make_log
from .forms import make_forms
from .lens import LENSES, make_lens, make_optics
from .lowpass import make_filter
from .projection_derivatives import make_projection_derivatives
from .records import RecordLayout
from .splat_pose import make_splat_pose
from .tile_lists import count_tiles

# [m]; invisible, and large enough that quotients are not float32 denormals
SMALLEST_SCALE = wp.constant(wp.float32(1e-20))
BLOCK = 128
"""threads of a block on a GPU"""
LIMITS = (BLOCK, 5)  # threads per block, blocks at once: limits the kernel to 96 registers instead of 103
GROUP_KEYS = wp.constant(wp.uint32(0x00800000))
"""sort key of the first coplanar group; keys of groups are below all keys of depths, so that groups are first
in lists"""
NONE, BITS = wp.constant(wp.uint32(0)), wp.constant(wp.uint64(32))


@cache
def make_project(
    effects: tuple[str, ...],
    outputs: tuple[str, ...],
    sh_coefficients: int,
    precision: str,
    every_bounds: bool,
):
    """Make the projection kernel for the effects and outputs that affect the records of projected splats.

    Args:
        sh_coefficients: SH coefficients per colour channel, 0 for plain colours. every_bounds: write the
        bounds of all visible splats; otherwise only of splats whose tiles exceed the bit mask `windows`.
    """
    layout = RecordLayout(effects, outputs)
    stride = layout.vec4s
    has_depth, has_lowpass_disc, filtered, k_buffered, layers = (
        name in effects
        for name in ("ray_depth", "lowpass_screen", "lowpass_pixel", "order_pixel", "order_coplanar")
    )
    recorded = output.having(outputs, "project")
    projects = output.functions(recorded, "project")
    words = [layout.word(output.declared(name).record[0]) for name in recorded]
    real = wp.float64 if precision == "float64" else wp.float32
    vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
    sqrt_two, half, two, zero = real(math.sqrt(2.0)), real(0.5), real(2.0), real(0.0)
    all_boxes, mixed = "footprint_box" in effects, "footprint_mixed" in effects
    boxes_too = all_boxes or mixed
    of_box, disk = make_boxes(real), make_disk(real)
    exact, has_ewa = EXACT in effects, any(name in effects for name in EWA)
    thick_too = exact or has_ewa
    has_surface_normals = has_ewa and len(projects) > 0
    ellipsoid = make_ellipsoids(effects, real)
    limits, color_of, widened = (
        make_bounds(has_lowpass_disc),
        make_color(sh_coefficients, real),
        make_filter(real),
    )
    ln = make_log(real)
    splat_pose = make_splat_pose(effects, real)
    Moving = splat_pose.Moving
    camera = next((name for name in effects if name in LENSES), None)
    parallel = "camera_orthographic" in effects
    ray_depths = camera in ("camera_fisheye", "camera_equirectangular")  # depths are distances
    has_lookup_table, has_lens = camera == "camera_brown_conrady", camera is not None
    edged = boxes_too and not has_lens  # straight edges, which records contain
    optics = make_optics(camera, real) if camera else None
    Lens, forms = make_lens(camera), make_forms(effects, outputs, real)
    derivatives_at = make_projection_derivatives("camera_orthographic" if parallel else camera, real)
    at_depth, at_nearest, at_box = (layout.word(name) for name in ("z_numerator", "nearest", "columns"))

    @wp.func
    def bounds_of(
        a: vec3, b: vec3, p: vec3, radius: real, reach: real, x: real, y: real, view: View, lens: Lens
    ):
        """Image bounds of a disk p + u a + v b, u^2 + v^2 <= radius^2, for any camera. reach: half of its
        depth range [m]. x, y: projected centre, which only parallel rays use."""
        if wp.static(parallel):
            return disk.parallel(a, b, x, y, radius, view)
        elif wp.static(ray_depths):
            return optics.enclose(a, b, p, radius, view, lens)
        else:
            return disk.perspective(a, b, p, radius, reach, view)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False, launch_bounds=LIMITS)
    def project(
        first: int,  # splat of thread 0; splats are numbered view after view
        views: wp.array(dtype=View),
        moving: Moving,
        lens: Lens,
        means: wp.array(dtype=wp.vec3),  # (n) [m], relative to the cloud's origin
        quats: wp.array(dtype=wp.vec4),  # (n) w x y z
        scales: wp.array(dtype=wp.vec2),  # (n) [m]
        opacities: wp.array(dtype=wp.float32),  # (n)
        colors: wp.array(dtype=wp.vec3),  # (n), or (n sh_coefficients)
        coplanar_groups: wp.array(dtype=wp.int32),  # (n) index of the splat's coplanar group; -1: none
        boxes: wp.array(dtype=wp.int32),  # (n) 1: a box; for clouds with boxes and other splats
        thickness: wp.array(dtype=wp.float32),  # (n) [m], for clouds with 3D Gaussians; 0: a disk
        records: wp.array(dtype=wp.vec4),  # (views n stride) out: records of visible splats
        bounds: wp.array(dtype=Bounds),  # (views n) out: see `every_bounds`
        windows: wp.array(
            dtype=wp.uint64
        ),  # (views n) out: window's first tile, then bits of the tiles; 0: more tiles than a window
        keys: wp.array(dtype=wp.uint32),  # (views n) out: depth key, or CULLED
        counts: wp.array(dtype=wp.int32),  # (views n) out: number of tiles that the splat may overlap
        counters: wp.array(dtype=wp.int32),  # in, out: see `count_tiles`
        big: wp.array(dtype=wp.int32),  # (views n) out: big splats, in any order
    ):
        at = wp.tid() + first
        number = at / views[0].splats
        view = views[reread(number)]
        i = at - number * view.splats
        # loaded before the first store, as the compiler assumes that a store may alias the arrays
        opacity, size = float(opacities[i]), wp.vec2(scales[i])
        quat, center = wp.vec4(quats[i]), wp.vec3(means[i])
        keys[at] = CULLED
        counts[at] = 0
        # conditions are written so that a NaN culls
        log_opacity = float(ln(real(opacity)))
        half_r2 = log_opacity - view.log_alpha_cutoff
        if not (half_r2 > 0.0 and opacity > 0.0 and opacity < wp.inf):
            return
        if not (size[0] >= 0.0 and size[0] < wp.inf and size[1] >= 0.0 and size[1] < wp.inf):
            return
        if wp.static(thick_too):
            if not (thickness[i] >= 0.0 and thickness[i] < wp.inf):
                return
        su = real(wp.max(size[0], SMALLEST_SCALE))
        sv = real(wp.max(size[1], SMALLEST_SCALE))

        rotation, translation, eye = splat_pose.pose(i, number, view, moving)
        tangent_u, tangent_v = splat_pose.tangents(rotation, quat)
        mean = vec3(real(center[0]), real(center[1]), real(center[2]))
        p = rotation * mean + translation
        unit_normal = wp.cross(tangent_u, tangent_v)
        offset = wp.dot(unit_normal, p)  # signed distance of the plane from the camera's centre
        if wp.static(parallel):
            offset = unit_normal[2]
        a, b = tangent_u * su, tangent_v * sv
        depth = p[2]
        if wp.static(ray_depths):
            depth = wp.length(p)

        near = real(view.near)
        own_filter = bool(False)  # whether the splat is filtered by its own footprint
        boxed = bool(wp.static(all_boxes))
        if wp.static(mixed):
            boxed = boxes[i] != 0
        if wp.static(boxes_too):
            own_filter = boxed
        third = vec3()  # semi-axis of an ellipsoid conjugate to a and b
        outward = vec3()  # normal of the ellipsoid's surface, if it differs from the disk's normal
        inverse_m2 = zero
        thick = bool(False)
        if wp.static(thick_too):
            thick = thickness[i] > 0.0
            if thick:
                sizes = vec3(su, sv, real(wp.max(thickness[i], SMALLEST_SCALE)))
                if wp.static(has_surface_normals):
                    outward = ellipsoid.surface(tangent_u, tangent_v, unit_normal, sizes, p)
                a, b, unit_normal, offset, third, inverse_m2, su, sv, log_compensation = ellipsoid.disk(
                    a, b, unit_normal, sizes, p, view
                )
                log_opacity += float(log_compensation)
                half_r2 = log_opacity - view.log_alpha_cutoff
                if not (half_r2 > 0.0):
                    return
                own_filter = wp.static(has_ewa)
        if wp.static(filtered):
            if depth >= near and not own_filter:
                by_x, by_y, by_depth, here = derivatives_at(p, view, lens)
                if here:
                    widening = widened(a, b, by_x, by_y, by_depth)
                    log_opacity -= float(half * ln(widening[3]))
                    half_r2 = log_opacity - view.log_alpha_cutoff
                    if not (half_r2 > 0.0):
                        return  # also edge-on for parallel rays: infinitely thin and faint
                    a = widening[0] * a + widening[1] * b
                    b = widening[2] * b
                    su *= widening[0]
                    sv *= widening[2]
        radius = wp.sqrt(two * real(half_r2))
        reach = radius * wp.sqrt(a[2] * a[2] + b[2] * b[2])  # half of the disk's depth range
        if wp.static(boxes_too):
            if boxed:
                reach = wp.abs(a[2]) + wp.abs(b[2])
        if wp.static(ray_depths):
            reach = radius * wp.sqrt(wp.max(wp.dot(a, a), wp.dot(b, b)))
            if wp.static(boxes_too):
                if boxed:
                    reach = su + sv
        rim, rim_reach = radius, reach  # disk whose image bounds the visible fragments
        if wp.static(exact):
            if thick:
                rim = ellipsoid.rim(radius, inverse_m2)
                rim_reach = rim * wp.sqrt(a[2] * a[2] + b[2] * b[2])
                reach = ellipsoid.reach(a, b, third, radius)
        if not (depth + reach >= near and depth - reach <= real(view.far)):
            return

        # image bounds
        fx, fy, cx, cy = real(view.focal_x), real(view.focal_y), real(view.center_x), real(view.center_y)
        in_front = depth >= near  # for a lens, whether the centre has an image
        center_x, center_y = zero, zero
        if wp.static(parallel):
            center_x, center_y = fx * p[0] + cx, fy * p[1] + cy
        elif wp.static(not has_lens):
            center_x = wp.clamp(fx * p[0] / near + cx, zero, real(view.width))
            center_y = wp.clamp(fy * p[1] / near + cy, zero, real(view.height))
            if in_front:
                center_x = (fx * p[0] + cx * p[2]) / p[2]
                center_y = (fy * p[1] + cy * p[2]) / p[2]
        box = Bounds()
        if wp.static(edged):
            if boxed:
                area = vec4()
                if wp.static(parallel):
                    area = of_box.parallel(tangent_u, tangent_v, su, sv, center_x, center_y, view)
                else:
                    area = of_box.extent(tangent_u, tangent_v, p, su, sv, p[2] - reach >= near, view)
                if not (area[0] <= area[1]):
                    return
                box = box_bounds(float(area[0]), float(area[1]), float(area[2]), float(area[3]))
            elif wp.static(mixed):
                box = bounds_of(a, b, p, rim, rim_reach, center_x, center_y, view, lens)
        elif wp.static(boxes_too):
            if boxed:
                # the disk around a larger rectangle
                sides = of_box.spread(tangent_u, tangent_v, p, su, sv, real(view.max_ray_derivative))
                side_u, side_v = tangent_u * sides[0], tangent_v * sides[1]
                range_z = sqrt_two * wp.length(vec2(side_u[2], side_v[2]))
                box = bounds_of(side_u, side_v, p, sqrt_two, range_z, center_x, center_y, view, lens)
            elif wp.static(mixed):
                box = bounds_of(a, b, p, rim, rim_reach, center_x, center_y, view, lens)
        else:
            box = bounds_of(a, b, p, rim, rim_reach, center_x, center_y, view, lens)
        if wp.static(exact and not parallel and not has_lens):
            if thick and p[2] - reach < near:
                box = ellipsoid.clipped(box, a, b, p, third, inverse_m2, view)
        if wp.static(has_lookup_table):
            x0, x1 = real(box.x - box.half_x), real(box.x + box.half_x)
            y0, y1 = real(box.y - box.half_y), real(box.y + box.half_y)
            box = optics.lut_bounds(x0, x1, y0, y1, lens)
        if wp.static(has_lens):
            if in_front:
                center_x, center_y, in_front = optics.image(p, view, lens)
        if wp.static(has_lowpass_disc):
            if in_front:
                box.lowpass_x = float(center_x)
                box.lowpass_y = float(center_y)
                box.lowpass_r = wp.sqrt(half_r2 / view.sample_area) * (1.0 + PAD_RELATIVE) + PAD
            if own_filter:
                box.lowpass_r = -1.0
        view = views[reread(number)]
        row_first, row_end = limits.rows(box, view.height)
        first_column, end_column = limits.span(box, row_first, row_end, view.width)
        if row_first >= row_end or first_column >= end_column:
            return
        left = divide(first_column, view.tile_w)
        columns = divide(end_column - 1, view.tile_w) - left + 1
        top = divide(row_first, view.tile_h)
        tile_rows = divide(row_end - 1, view.tile_h) - top + 1
        bits, tiles = limits.touched(box, left, columns, top, tile_rows, view)
        if tiles == 0:
            return

        # loaded again, here and above, to save registers
        view = views[reread(number)]
        record, met = forms(
            a, b, unit_normal, offset, p, su, sv, center_x, center_y,
            in_front, boxed, own_filter, thick, inverse_m2, view, lens,
        )  # fmt: skip
        if not met:
            return
        rotation, translation, eye = splat_pose.pose(i, number, view, moving)
        rgb = color_of(i, colors, mean - eye)
        if not (wp.isfinite(rgb[0]) and wp.isfinite(rgb[1]) and wp.isfinite(rgb[2])):
            return

        record[3] = log_opacity
        record[13] = rgb[0]
        record[14] = rgb[1]
        record[15] = rgb[2]
        record[at_box] = as_bits(first_column, end_column)
        record[at_box + 1] = as_bits(row_first, row_end)
        if wp.static(has_depth):
            coplanar_group = int(-1)
            if wp.static(layers):
                coplanar_group = coplanar_groups[i]
            middle, depth_reach = splat_pose.depth_range(depth, reach, radius, near, coplanar_group, boxed)
            record[at_depth + 1] = float(middle)
            record[at_depth + 2] = float(depth_reach)
        key = float(depth)
        if wp.static(k_buffered):
            key = float(middle) - float(depth_reach)  # lower bound of the depths, as in blending
            record[at_nearest] = key
        if wp.static(has_surface_normals):
            if thick:
                unit_normal = outward
        for k in range(wp.static(len(projects))):
            record = wp.static(projects[k])(record, wp.static(words[k]), unit_normal, offset)
        for n in range(wp.static(stride)):
            k = 4 * n
            store_vec4(
                records, at * stride + n, wp.vec4(record[k], record[k + 1], record[k + 2], record[k + 3])
            )
        if wp.static(every_bounds) or bits == NONE:
            bounds[at] = box
        corner = (number * view.tiles_y + top) * view.tiles_x + left
        windows[at] = (wp.uint64(corner) << BITS) | wp.uint64(bits)
        keys[at] = sortable(key)
        if wp.static(layers):
            if coplanar_groups[i] >= 0:
                keys[at] = GROUP_KEYS + wp.uint32(coplanar_groups[i])
        counts[at] = tiles
        count_tiles(at, corner, bits, view, counters, big)

    return project
