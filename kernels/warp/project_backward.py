"""Backward pass of the projection: from derivatives with respect to a splat's record, stored per tile, to
derivatives with respect to mean, rotation, scales, opacity, colour and camera. Thresholds and order are held
constant.

With a = s_u t_u and b = s_v t_v, a ray r has the forms n_u = (b x p) r, n_v = (p x a) r, D = (a x b) r, up to
a common factor without effect. From the moment g = sum dL/dn_u r over rays follow the derivatives p x g with
respect to b and g x b with respect to p; likewise for n_v and D.
"""

import math
from functools import cache

import warp as wp

from .color import basis_value
from .common import CULLED, STRICT, View, load_vec4
from .ellipsoids import EWA, EXACT, make_ellipsoids
from .ellipsoids_backward import make_ellipsoids_backward
from .project import SMALLEST_SCALE
from .records import RecordLayout

TEN = wp.types.vector(10, wp.float64)
"""gradient with respect to a motion after world_to_camera: rotation vector [1 / rad], translation [1 / m];
and with respect to fx, fy, cx, cy [1 / px]"""
_ZERO, _HALF, _ONE, _TWO = (wp.constant(wp.float64(x)) for x in (0.0, 0.5, 1.0, 2.0))
_SQRT_HALF = wp.constant(wp.float64(math.sqrt(0.5)))


@wp.func
def basis_slope(k: int, d: wp.vec3) -> wp.vec3:
    """Gradient of `basis_value` with respect to the direction."""
    x, y, z = d[0], d[1], d[2]
    if k == 1:
        return wp.vec3(0.0, -0.48860251190291992, 0.0)
    elif k == 2:
        return wp.vec3(0.0, 0.0, 0.48860251190291992)
    elif k == 3:
        return wp.vec3(-0.48860251190291992, 0.0, 0.0)
    elif k == 4:
        return 1.0925484305920792 * wp.vec3(y, x, 0.0)
    elif k == 5:
        return -1.0925484305920792 * wp.vec3(0.0, z, y)
    elif k == 6:
        return 0.31539156525252005 * wp.vec3(-2.0 * x, -2.0 * y, 4.0 * z)
    elif k == 7:
        return -1.0925484305920792 * wp.vec3(z, 0.0, x)
    elif k == 8:
        return 0.54627421529603959 * wp.vec3(2.0 * x, -2.0 * y, 0.0)
    elif k == 9:
        return -0.59004358992664352 * wp.vec3(6.0 * x * y, 3.0 * (x * x - y * y), 0.0)
    elif k == 10:
        return 2.8906114426405538 * wp.vec3(y * z, x * z, x * y)
    elif k == 11:
        across = 4.0 * z * z - x * x - 3.0 * y * y
        return -0.45704579946446572 * wp.vec3(-2.0 * x * y, across, 8.0 * y * z)
    elif k == 12:
        along = 6.0 * z * z - 3.0 * x * x - 3.0 * y * y
        return 0.37317633259011546 * wp.vec3(-6.0 * x * z, -6.0 * y * z, along)
    elif k == 13:
        across = 4.0 * z * z - 3.0 * x * x - y * y
        return -0.45704579946446572 * wp.vec3(across, -2.0 * x * y, 8.0 * x * z)
    elif k == 14:
        return 1.4453057213202769 * wp.vec3(2.0 * x * z, -2.0 * y * z, x * x - y * y)
    elif k == 15:
        return -0.59004358992664352 * wp.vec3(3.0 * (x * x - y * y), -6.0 * x * y, 0.0)
    return wp.vec3()


@cache
def make_project_backward(
    effects: tuple[str, ...], outputs: tuple[str, ...], names: tuple[str, ...], sh_coefficients: int
):
    """Make the kernel of the backward pass of the projection. effects, outputs: of the record. names: names
    of the sums. sh_coefficients: SH coefficients per colour, 0 for plain colours."""
    layout = RecordLayout(effects, outputs)
    stride, fields = layout.vec4s, len(names)
    at = {name: position for position, name in enumerate(names)}
    GradientSums, Totals = (wp.types.vector(fields, real) for real in (wp.float32, wp.float64))
    screen_filter, has_depth, normal = (name in at for name in ("lowpass_x", "z_center", "nx"))
    exact, ewa = EXACT in effects, any(name in effects for name in EWA)
    has_gaussians = exact or ewa
    ellipsoid, solid_backward = make_ellipsoids(effects, wp.float64), make_ellipsoids_backward(effects)
    zc_vec4, zc_component = layout.position("z_center")
    terms = max(sh_coefficients, 1)
    lowpass_x, z_numerator, nx, ellipsoid_term = (
        at.get(name, 0) for name in ("lowpass_x", "z_numerator", "nx", "ellipsoid_term")
    )

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def project_backward(
        first: int,  # splat of thread 0
        views: wp.array(dtype=View),  # (1)
        means: wp.array(dtype=wp.vec3),
        quats: wp.array(dtype=wp.vec4),
        scales: wp.array(dtype=wp.vec2),
        thickness: wp.array(dtype=wp.float32),  # for clouds with 3D Gaussians; 0: a disk
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=wp.vec3),  # (n), or (n sh_coefficients)
        records: wp.array(dtype=wp.vec4),
        keys: wp.array(dtype=wp.uint32),
        counts: wp.array(dtype=wp.int32),
        ends_by_index: wp.array(dtype=wp.int32),
        gradient_sums: wp.array(dtype=GradientSums),  # by gradient buffer offset
        grad_means: wp.array(dtype=wp.vec3),  # out, as all arrays below; 0 for culled splats
        grad_quats: wp.array(dtype=wp.vec4),
        grad_scales: wp.array(dtype=wp.vec2),
        grad_thickness: wp.array(dtype=wp.float32),  # for clouds with 3D Gaussians
        grad_opacities: wp.array(dtype=wp.float32),
        grad_colors: wp.array(dtype=wp.vec3),
        grad2d: wp.array(
            dtype=wp.float32
        ),  # norm of the gradient with respect to the projected centre, in half images
        grad_cameras: wp.array(dtype=TEN),
    ):
        view = views[0]
        i = first + wp.tid()
        grad_means[i] = wp.vec3()
        grad_quats[i] = wp.vec4()
        grad_scales[i] = wp.vec2()
        if wp.static(has_gaussians):
            grad_thickness[i] = 0.0
        grad_opacities[i] = 0.0
        grad2d[i] = 0.0
        grad_cameras[i] = TEN()
        for k in range(terms):
            grad_colors[i * terms + k] = wp.vec3()
        if keys[i] == CULLED:
            return
        total = Totals()
        for offset in range(ends_by_index[i] - counts[i], ends_by_index[i]):
            values = gradient_sums[offset]
            for field in range(wp.static(fields)):
                total[field] = total[field] + wp.float64(values[field])

        # colour
        mean = wp.vec3d(wp.float64(means[i][0]), wp.float64(means[i][1]), wp.float64(means[i][2]))
        grad_rgb = wp.vec3(float(total[10]), float(total[11]), float(total[12]))
        grad_ray = wp.vec3d()  # with respect to the vector from the eye to the centre, in world axes
        if wp.static(sh_coefficients == 0):
            grad_colors[i] = grad_rgb
        else:
            clamped = load_vec4(
                records, i * stride + 3
            )  # ay, r, g, b; colours clamped at 0 have no derivative
            for channel in range(3):
                if not (clamped[channel + 1] > 0.0):
                    grad_rgb[channel] = 0.0
            away = mean - view.eye
            length = wp.length(away)
            if length > _ZERO:
                away = away / length
            direction = wp.vec3(float(away[0]), float(away[1]), float(away[2]))
            slope = wp.vec3()
            for k in range(terms):
                grad_colors[i * terms + k] = basis_value(k, direction) * grad_rgb
                slope += wp.dot(colors[i * terms + k], grad_rgb) * basis_slope(k, direction)
            if length > _ZERO:
                grad_away = wp.vec3d(wp.float64(slope[0]), wp.float64(slope[1]), wp.float64(slope[2]))
                grad_ray = (grad_away - wp.dot(grad_away, away) * away) / length

        # the disk, in the camera's axes
        q = quats[i]
        w, x, y, z = wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])
        s = _TWO / (w * w + x * x + y * y + z * z)
        turn = view.rotation
        unit_a = turn * wp.vec3d(_ONE - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y))
        unit_b = turn * wp.vec3d(s * (x * y - w * z), _ONE - s * (x * x + z * z), s * (y * z + w * x))
        p = turn * mean + view.translation
        size = scales[i]
        su, sv = wp.float64(wp.max(size[0], SMALLEST_SCALE)), wp.float64(wp.max(size[1], SMALLEST_SCALE))
        a, b = su * unit_a, sv * unit_b
        if wp.static(has_gaussians):
            unit_normal, sizes = wp.cross(unit_a, unit_b), wp.vec3d(su, sv, _ZERO)
            if thickness[i] > 0.0:
                sizes[2] = wp.float64(wp.max(thickness[i], SMALLEST_SCALE))
                of_disk = ellipsoid.disk(a, b, unit_normal, sizes, p, view)
                a = of_disk[0]
                b = of_disk[1]

        # the record's forms, and their common factor
        anchor = load_vec4(records, i * stride + 2)[3]
        ray = wp.vec3d(
            (wp.float64(anchor) + _HALF - view.center_x) * view.per_focal_x,
            (wp.float64(load_vec4(records, i * stride + 3)[0]) + _HALF - view.center_y) * view.per_focal_y,
            _ONE,
        )
        form_u, form_v, form_d = wp.cross(b, p), wp.cross(p, a), wp.cross(a, b)
        steep_x = wp.max(wp.abs(form_u[0]), wp.abs(form_v[0])) * view.per_focal_x
        steep_y = wp.max(wp.abs(form_u[1]), wp.abs(form_v[1])) * view.per_focal_y
        if wp.static(ewa):
            if thickness[i] > 0.0:
                steep_x = wp.abs(form_d[2])
                steep_y = steep_x
        height = wp.dot(form_d, p)
        scale = wp.where(height < _ZERO, -_ONE, _ONE) / wp.max(steep_x, steep_y)
        n_scale = scale * _SQRT_HALF
        per_x, per_y = view.per_focal_x, view.per_focal_y
        g_u = n_scale * (total[0] * ray + wp.vec3d(total[1] * per_x, total[2] * per_y, _ZERO))
        g_v = n_scale * (total[3] * ray + wp.vec3d(total[4] * per_x, total[5] * per_y, _ZERO))
        g_d = scale * (total[6] * ray + wp.vec3d(total[7] * per_x, total[8] * per_y, _ZERO))
        if wp.static(has_depth):
            # by z_numerator - z_center D, z_numerator = (a x b) p: small differences of large numbers
            volume = scale * total[z_numerator]
            along = wp.vec3d(total[z_numerator + 1] * per_x, total[z_numerator + 2] * per_y, _ZERO)
            center = wp.float64(load_vec4(records, i * stride + zc_vec4)[zc_component])
            g_d += volume * (p - center * ray) - scale * center * along
        grad_a = wp.cross(g_v, p) + wp.cross(b, g_d)
        grad_b = wp.cross(p, g_u) + wp.cross(g_d, a)
        grad_p = wp.cross(g_u, b) + wp.cross(a, g_v)
        grad_log = total[9]
        if wp.static(has_depth):
            grad_p += volume * form_d
        if wp.static(screen_filter):
            grad_x, grad_y = (
                total[lowpass_x] * view.focal_x / p[2],
                total[lowpass_x + 1] * view.focal_y / p[2],
            )
            grad_p += wp.vec3d(grad_x, grad_y, -(grad_x * p[0] + grad_y * p[1]) / p[2])
        # with respect to the projected centre, in half images
        across = wp.float64(view.width) * grad_p[0] * per_x
        down = wp.float64(view.height) * grad_p[1] * per_y
        grad2d[i] = float(_HALF * p[2] * wp.sqrt(across * across + down * down))
        # images depend on fx x + cx z and fy y + cy z of a, b and p
        grad_fx = per_x * (grad_a[0] * a[0] + grad_b[0] * b[0] + grad_p[0] * p[0])
        grad_fy = per_y * (grad_a[1] * a[1] + grad_b[1] * b[1] + grad_p[1] * p[1])
        grad_cx = per_x * (grad_a[0] * a[2] + grad_b[0] * b[2] + grad_p[0] * p[2])
        grad_cy = per_y * (grad_a[1] * a[2] + grad_b[1] * b[2] + grad_p[1] * p[2])
        if wp.static(has_depth):
            grad_p[2] = grad_p[2] + total[z_numerator + 3]
        grad_su, grad_sv = wp.dot(grad_a, unit_a), wp.dot(grad_b, unit_b)
        grad_unit_a, grad_unit_b = su * grad_a, sv * grad_b
        grad_facet = wp.vec3d()
        if wp.static(normal):
            grad_facet = wp.vec3d(total[nx], total[nx + 1], total[nx + 2])
            grad_facet *= wp.where(height > _ZERO, -_ONE, _ONE)
        if wp.static(has_gaussians):
            if thickness[i] > 0.0:
                grad_axes, grad_sizes, grad_p, grad_camera = solid_backward(
                    wp.matrix_from_rows(unit_a, unit_b, unit_normal), sizes, p, grad_a, grad_b, grad_p,
                    wp.vec4d(grad_fx, grad_fy, grad_cx, grad_cy), grad_log, total[ellipsoid_term], grad_facet,
                    view,
                )  # fmt: skip
                grad_fx, grad_fy, grad_cx, grad_cy = (
                    grad_camera[0],
                    grad_camera[1],
                    grad_camera[2],
                    grad_camera[3],
                )
                grad_unit_a, grad_unit_b, grad_facet = grad_axes[0], grad_axes[1], grad_axes[2]
                grad_su, grad_sv = grad_sizes[0], grad_sizes[1]
                if thickness[i] >= SMALLEST_SCALE:
                    grad_thickness[i] = float(grad_sizes[2])
                if wp.static(exact):
                    across = wp.float64(view.width) * grad_p[0] * per_x
                    down = wp.float64(view.height) * grad_p[1] * per_y
                    grad2d[i] = float(_HALF * p[2] * wp.sqrt(across * across + down * down))
        grad_scales[i] = wp.vec2(
            wp.where(size[0] >= SMALLEST_SCALE, float(grad_su), 0.0),
            wp.where(size[1] >= SMALLEST_SCALE, float(grad_sv), 0.0),
        )
        if wp.static(normal or has_gaussians):
            grad_unit_a += wp.cross(unit_b, grad_facet)
            grad_unit_b += wp.cross(grad_facet, unit_a)

        turned = wp.cross(p, grad_p) + wp.cross(unit_a, grad_unit_a) + wp.cross(unit_b, grad_unit_b)
        moved = grad_p + turn * grad_ray
        grad_cameras[i] = TEN(
            turned[0], turned[1], turned[2], moved[0], moved[1], moved[2], grad_fx, grad_fy, grad_cx, grad_cy
        )
        back = wp.transpose(turn)
        grad_mean = back * grad_p + grad_ray
        u, v = back * grad_unit_a, back * grad_unit_b
        # tangents are 1 - s (y y + z z) and so on with s = 2 / |q|^2
        grad_s = u[1] * (x * y + w * z) - u[0] * (y * y + z * z) + u[2] * (x * z - w * y)
        grad_s += v[0] * (x * y - w * z) - v[1] * (x * x + z * z) + v[2] * (y * z + w * x)
        inward = -s * grad_s
        grad_w = u[1] * z - u[2] * y - v[0] * z + v[2] * x + inward * w
        grad_x4 = u[1] * y + u[2] * z + v[0] * y - _TWO * v[1] * x + v[2] * w + inward * x
        grad_y4 = u[1] * x - _TWO * u[0] * y - u[2] * w + v[0] * x + v[2] * z + inward * y
        grad_z4 = u[1] * w - _TWO * u[0] * z + u[2] * x - v[0] * w - _TWO * v[1] * z + v[2] * y + inward * z
        grad_quats[i] = wp.vec4(float(s * grad_w), float(s * grad_x4), float(s * grad_y4), float(s * grad_z4))
        grad_means[i] = wp.vec3(float(grad_mean[0]), float(grad_mean[1]), float(grad_mean[2]))
        grad_opacities[i] = float(grad_log / wp.float64(opacities[i]))

    return project_backward
