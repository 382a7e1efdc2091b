"""Derivatives of compositing, fragment by fragment. The colour of a pixel is
C = sum_k T_k alpha_k c_k + T_end C_behind. With g = dL / dC, and B_k the gradient with respect to the
transmittance behind fragment k, from back to front

    B_end = g C_behind,   B_(k-1) = B_k + alpha_k (g c_k - B_k),   dL / d alpha_k = T_k (g c_k - B_k).

Nothing is divided by 1 - alpha, so opaque fragments need no special case.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .buffers import make_samples, sample_fields
from .common import View, fma, load_vec4, of_bits, struct_of
from .ellipsoids import EXACT
from .intersection import HALF_RHO_OF_RANGE, make_intersection
from .output.distortion import INVERSE_DEPTH, SPREAD_NEAR
from .records import RecordLayout
from .splat import make_splat

_FORMS = ("nu0", "nux", "nuy", "nv0", "nvx", "nvy", "d0", "dx", "dy", "log_opacity", "r", "g", "b")


def gradient_sum_names(effects: tuple[str, ...], outputs: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the sums that a fragment adds to for its splat: derivatives of the loss with respect to each
    form and z_numerator, times 1, x and y relative to the anchor; with respect to ln(opacity), the
    colour, and other numbers of the record. The derivative with respect to D is at constant z_numerator -
    z_center D, to avoid cancellation with that of z_numerator; `make_project_backward` adds the rest in
    float64."""
    names = list(_FORMS)
    names += ("lowpass_x", "lowpass_y") if "lowpass_screen" in effects else ()
    names += ("z_numerator", "z_numerator_x", "z_numerator_y", "z_center") if "ray_depth" in effects else ()
    names += ("nx", "ny", "nz") if "normal" in outputs else ()
    names += ("ellipsoid_term",) if EXACT in effects else ()
    return tuple(names)


@cache
def make_fragments(effects: tuple[str, ...], outputs: tuple[str, ...], gradient_outputs: tuple[str, ...]):
    """Make the structs ImageGradients (derivatives with respect to the images named in `gradient_outputs`),
    Samples, Splat, PixelGradient and GradientSums, and the functions read, pixel_gradient_at, alpha_at and
    fragment_gradient. effects, outputs: as for blending.
    """
    splats, intersection = make_splat(effects, outputs), make_intersection(effects, outputs)
    Splat, Intersection = splats.Splat, intersection.Intersection
    cross, column_of, alpha_of = intersection.cross, intersection.column, intersection.alpha_of
    has_lowpass_disc, exclusive, has_depth, thick = (
        name in effects for name in ("lowpass_screen", "stop_exclusive", "ray_depth", EXACT)
    )
    has_alpha, depth, normal, distortion = (
        name in gradient_outputs for name in ("alpha", "depth", "normal", "distortion")
    )
    names = gradient_sum_names(effects, outputs)
    at = {name: position for position, name in enumerate(names)}
    GradientSums = wp.types.vector(len(names), wp.float32)
    layout = RecordLayout(effects, outputs)
    stride = layout.vec4s
    z_vec4, z_component = layout.position("z_numerator")
    zc_vec4, zc_component = layout.position("z_center")
    zr_vec4, zr_component = layout.position("z_reach")
    normals = [layout.position(name) for name in ("nx", "ny", "nz")]
    box_vec4, box_component = layout.position("columns")
    rows_vec4, rows_component = layout.position("rows")
    Samples = make_samples(tuple(sample_fields(outputs).items()))
    arrays = {name: wp.array(dtype=wp.float32) for name in gradient_outputs}
    ImageGradients = struct_of(
        "ImageGradients", "Derivatives of a loss with respect to the images, (h w channels) each.", arrays
    )
    fields = {"grad_rgb": wp.vec3, "behind": wp.float32}
    fields |= {"depth": wp.float32, "depth_weight": wp.float32} if depth else {}
    fields |= {"normal": wp.vec3} if normal else {}
    fields |= {"distortion": wp.float32, "spread": wp.vec4} if distortion else {}
    PixelGradient = struct_of(
        "PixelGradient",
        "Derivatives of a pixel: with respect to its outputs, and to the transmittance behind.",
        fields,
    )

    @wp.func
    def box_of(records: wp.array(dtype=wp.vec4), index: int) -> wp.vec4i:
        """Box of samples that the splat may overlap: columns [first, end), then rows [first, end)."""
        left, end = of_bits(load_vec4(records, index * stride + box_vec4)[box_component])
        top, bottom = of_bits(load_vec4(records, index * stride + rows_vec4)[rows_component])
        return wp.vec4i(left, end, top, bottom)

    @wp.func
    def pixel_gradient_at(
        x: int, y: int, image_gradients: ImageGradients, samples: Samples, background: wp.vec3, view: View
    ):
        """Loss gradients of a pixel; zeros outside of the image."""
        pixel_gradient = PixelGradient()
        if x < view.width and y < view.height:
            pixel = y * view.width + x
            position = y * view.tiles_x * view.tile_w + x
            pixel_gradient.grad_rgb = wp.vec3(
                image_gradients.rgb[3 * pixel],
                image_gradients.rgb[3 * pixel + 1],
                image_gradients.rgb[3 * pixel + 2],
            )
            pixel_gradient.behind = wp.dot(pixel_gradient.grad_rgb, background)
            if wp.static(has_alpha):
                pixel_gradient.behind -= image_gradients.alpha[pixel]
            if wp.static(depth):
                # sum w z / sum w
                sums = samples.depth[position]
                if sums[1] > 0.0:
                    pixel_gradient.depth = image_gradients.depth[pixel] / sums[1]
                    pixel_gradient.depth_weight = -pixel_gradient.depth * (sums[0] / sums[1])
            if wp.static(normal):
                # the direction of sum w n
                length = wp.length(samples.normal[position])
                if length > 0.0:
                    unit = samples.normal[position] / length
                    grad_unit = wp.vec3(
                        image_gradients.normal[3 * pixel],
                        image_gradients.normal[3 * pixel + 1],
                        image_gradients.normal[3 * pixel + 2],
                    )
                    pixel_gradient.normal = (grad_unit - wp.dot(grad_unit, unit) * unit) / length
            if wp.static(distortion):
                pixel_gradient.distortion = image_gradients.distortion[pixel]
                pixel_gradient.spread = samples.distortion[position]
        return pixel_gradient

    @wp.func
    def crossed(s: Splat, x: float, y: float, view: View):
        return cross(s, column_of(s.u, x), column_of(s.v, x), column_of(s.d, x), x, y, view)

    @wp.func
    def alpha_at(s: Splat, column: int, row: int, transmittance: float, view: View) -> float:
        """Alpha of a splat at a sample, with the decisions of the forward pass: 0 if it is not blended, -1 if
        it terminates the sample without being blended."""
        alpha = float(0.0)
        if transmittance > view.transmittance_stop:
            c = crossed(s, float(column) - s.d[3], float(row) - s.c[0], view)
            if c.contributes:
                alpha = alpha_of(s, c, 1.0 / c.d, view)
                if wp.static(exclusive):
                    if transmittance * (1.0 - alpha) <= view.transmittance_stop:
                        alpha = -1.0
        return alpha

    @wp.func
    def depth_at(
        records: wp.array(dtype=wp.vec4),
        index: int,
        s: Splat,
        c: Intersection,
        inverse_d: float,
        lowpass_half_rho: float,
    ):
        """Depth z of a fragment and its derivatives.

        c: D and q of the intersection, rho / 2 = q / D^2. For a 3D Gaussian, D and q are those of its disk
        times 1 + t, t = ellipsoid_term q / D^2. lowpass_half_rho: rho / 2 of the low-pass disc. Up to
        rho / 2 = circle = max(lowpass_half_rho, ln 255), z is z_numerator / D; if rounding moves it out of
        the splat's depth range, it has the derivatives of z_center. Beyond, z is
        z_center + circle (z_numerator - z_center D) D / q.

        Returns z; the derivatives with respect to z_numerator, z_center, and D at constant
        z_numerator - z_center D; with respect to q and lowpass_half_rho; and with respect to ellipsoid_term.
        """
        position = index * stride
        center = load_vec4(records, position + zc_vec4)[zc_component]
        reach = load_vec4(records, position + zr_vec4)[zr_component]
        numerator = load_vec4(records, position + z_vec4)[z_component]
        z, grad_record, grad_dot = center, wp.vec3(0.0, 1.0, 0.0), wp.vec2()
        ahead = c.d > 0.0 and c.d <= s.v[3]
        circle = wp.max(lowpass_half_rho, HALF_RHO_OF_RANGE)
        if ahead and c.q * inverse_d * inverse_d <= circle:
            met = numerator * inverse_d
            z = wp.clamp(met, center - reach, center + reach)
            if met == z:
                grad_record = wp.vec3(inverse_d, 0.0, (center - z) * inverse_d)
        elif ahead:
            beyond, taken = numerator - center * c.d, circle * c.d / c.q
            z = wp.clamp(fma(taken, beyond, center), center - reach, center + reach)
            grad_record = wp.vec3(taken, 1.0 - taken * c.d, circle / c.q * beyond)
            grad_dot = wp.vec2(
                -taken * beyond / c.q, wp.where(circle == lowpass_half_rho, beyond * c.d / c.q, 0.0)
            )
        grad_ellipsoid_term = float(0.0)
        if wp.static(thick):
            if s.ellipsoid_term > 0.0 and ahead:
                slant = c.q * inverse_d  # q / D: finite for the thinnest needles, whose half_rho overflows
                share = s.ellipsoid_term * inverse_d * slant
                rest = wp.max(1.0 - share, 1.0e-6)  # 1 / (1 + t)
                t = share / rest
                grad_d = grad_record[2] - center * grad_record[0]
                grad_ellipsoid_term = slant * fma(slant, grad_dot[0], grad_d)
                grad_record[2] = grad_record[2] - t * fma(2.0 * slant, grad_dot[0], grad_d)
                grad_dot[0] = (
                    fma(2.0 * t, grad_dot[0], grad_dot[0]) + grad_d * s.ellipsoid_term * inverse_d / rest
                )
        return z, grad_record, grad_dot, grad_ellipsoid_term

    @wp.func
    def fragment_gradient(
        s: Splat,
        index: int,
        column: int,
        row: int,
        transmittance: float,
        alpha: float,
        before: PixelGradient,
        log_ceiling: float,
        records: wp.array(dtype=wp.vec4),
        view: View,
    ):
        """Contribution of a fragment to the derivatives with respect to its record, and the state of the
        pixel in front of it. transmittance: in front of the fragment."""
        pixel_gradient = before
        x, y = float(column) - s.d[3], float(row) - s.c[0]
        c = crossed(s, x, y, view)
        nu, nv = fma(s.u[2], y, column_of(s.u, x)), fma(s.v[2], y, column_of(s.v, x))
        inverse_d = float(0.0)
        if c.d > 0.0:
            inverse_d = 1.0 / c.d
        half_rho = c.q * inverse_d * inverse_d
        min_half_rho = half_rho
        on_plane = c.inside
        if wp.static(has_lowpass_disc):
            on_plane = c.inside and half_rho <= c.lowpass_half_rho
            if not on_plane:
                min_half_rho = c.lowpass_half_rho

        weight = transmittance * alpha
        color = wp.vec3(s.c[1], s.c[2], s.c[3])
        grad_weight = wp.dot(pixel_gradient.grad_rgb, color)
        z, grad_record, grad_dot_depth, grad_ellipsoid_term = float(0.0), wp.vec3(), wp.vec2(), float(0.0)
        grad_z = float(0.0)
        if wp.static(has_depth):
            lowpass_half_rho = float(wp.inf)
            if wp.static(has_lowpass_disc):
                lowpass_half_rho = c.lowpass_half_rho
            z, grad_record, grad_dot_depth, grad_ellipsoid_term = depth_at(
                records, index, s, c, inverse_d, lowpass_half_rho
            )
        if wp.static(depth):
            grad_weight += fma(pixel_gradient.depth, z, pixel_gradient.depth_weight)
            grad_z += weight * pixel_gradient.depth
        if wp.static(normal):
            facing = wp.vec3(
                load_vec4(records, index * stride + wp.static(normals[0][0]))[wp.static(normals[0][1])],
                load_vec4(records, index * stride + wp.static(normals[1][0]))[wp.static(normals[1][1])],
                load_vec4(records, index * stride + wp.static(normals[2][0]))[wp.static(normals[2][1])],
            )
            grad_weight += wp.dot(pixel_gradient.normal, facing)
        if wp.static(distortion):
            # dL / dw = g (sum w m^2 + W m^2 - 2 m sum w m), dL / dm = 2 g w (W m - sum w m)
            spread = pixel_gradient.spread
            if z > 0.0:
                nearer = INVERSE_DEPTH / wp.max(z, SPREAD_NEAR) - spread[0]
                grad_weight += pixel_gradient.distortion * fma(
                    fma(spread[1], nearer, -2.0 * spread[2]), nearer, spread[3]
                )
            if z > SPREAD_NEAR:
                inverse_z = 1.0 / z
                outward = fma(spread[1], fma(INVERSE_DEPTH, inverse_z, -spread[0]), -spread[2])
                grad_z -= (
                    2.0 * INVERSE_DEPTH * weight * pixel_gradient.distortion * outward * inverse_z * inverse_z
                )
        gain = grad_weight - pixel_gradient.behind
        pixel_gradient.behind = fma(alpha, gain, pixel_gradient.behind)
        grad_log = weight * gain
        if not (s.u[3] - min_half_rho <= log_ceiling):
            grad_log = 0.0  # clamped to the maximum alpha

        grad_nu, grad_nv, grad_d = float(0.0), float(0.0), float(0.0)
        if on_plane:
            plane = 2.0 * grad_log * inverse_d
            grad_nu = -plane * nu * inverse_d
            grad_nv = -plane * nv * inverse_d
            grad_d = plane * half_rho
        m = GradientSums()
        if wp.static(has_depth):
            numerator = grad_z * grad_record[0]
            m[wp.static(at.get("z_numerator", 0))] = numerator
            m[wp.static(at.get("z_numerator_x", 0))] = numerator * x
            m[wp.static(at.get("z_numerator_y", 0))] = numerator * y
            m[wp.static(at.get("z_center", 0))] = grad_z * grad_record[1]
            grad_d += grad_z * grad_record[2]
            grad_nu += 2.0 * grad_z * grad_dot_depth[0] * nu
            grad_nv += 2.0 * grad_z * grad_dot_depth[0] * nv
        if wp.static(has_lowpass_disc):
            grad_dot = 2.0 * view.sample_area * grad_log
            if on_plane:
                grad_dot = 0.0
            grad_dot -= 2.0 * view.sample_area * grad_z * grad_dot_depth[1]
            m[wp.static(at.get("lowpass_x", 0))] = grad_dot * (x - s.lowpass_x)
            m[wp.static(at.get("lowpass_y", 0))] = grad_dot * (y - s.lowpass_y)
        if wp.static(normal):
            for k in range(3):
                m[wp.static(at.get("nx", 0)) + k] = weight * pixel_gradient.normal[k]
        if wp.static(thick):
            if on_plane:
                grad_ellipsoid_term = fma(grad_log, half_rho * half_rho, grad_z * grad_ellipsoid_term)
            else:
                grad_ellipsoid_term *= grad_z
            m[wp.static(at.get("ellipsoid_term", 0))] = grad_ellipsoid_term
        m[0] = grad_nu
        m[1] = grad_nu * x
        m[2] = grad_nu * y
        m[3] = grad_nv
        m[4] = grad_nv * x
        m[5] = grad_nv * y
        m[6] = grad_d
        m[7] = grad_d * x
        m[8] = grad_d * y
        m[9] = grad_log
        m[10] = weight * pixel_gradient.grad_rgb[0]
        m[11] = weight * pixel_gradient.grad_rgb[1]
        m[12] = weight * pixel_gradient.grad_rgb[2]
        return m, pixel_gradient

    return SimpleNamespace(
        ImageGradients=ImageGradients,
        Samples=Samples,
        Splat=Splat,
        PixelGradient=PixelGradient,
        GradientSums=GradientSums,
        read=splats.read,
        box_of=box_of,
        pixel_gradient_at=pixel_gradient_at,
        alpha_at=alpha_at,
        fragment_gradient=fragment_gradient,
    )
