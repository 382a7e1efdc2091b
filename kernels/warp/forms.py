"""The affine forms of a splat's record, which each sample evaluates for its ray.

With rows T_u, T_v, T_w of the projection of tangents and centre, (n_u, n_v, D) = T_u x T_v + x (T_v x T_w) +
y (T_w x T_u): kernels/opencl/splat.cl. All three are affine in the sample. A common factor makes D > 0 in
front of the camera and the steepest slope 1; n_u and n_v also have the factor sqrt(1/2), so that (n_u^2 +
n_v^2) / D^2 is rho / 2. Operations and their order are those of kernels/opencl/project.cl, so results are
bit-identical.
"""

import math
from functools import cache

import warp as wp

from .boxes import make_boxes
from .common import View
from .ellipsoids import EWA, EXACT
from .lens import LENSES, make_lens, make_optics
from .records import BOXES, RecordLayout


@cache
def make_forms(effects: tuple[str, ...], outputs: tuple[str, ...], real):
    """Make the function that fills a record for these effects and outputs."""
    layout = RecordLayout(effects, outputs)
    vec3 = wp.types.vector(3, real)
    words = wp.types.vector(4 * layout.vec4s, wp.float32)
    sqrt_half, edge_on = real(math.sqrt(0.5)), real(1e-13 if real is wp.float64 else 1e-6)
    one, two, half, zero = real(1.0), real(2.0), real(0.5), real(0.0)
    has_depth, has_lowpass_disc, parallel, exact = (
        name in effects for name in ("ray_depth", "lowpass_screen", "camera_orthographic", EXACT)
    )
    ewa = any(name in effects for name in EWA)
    camera = next((name for name in effects if name in LENSES), None)
    has_lens = camera is not None
    edged = not has_lens and any(name in effects for name in BOXES)
    flagged = has_lens and "footprint_mixed" in effects
    """whether records have edges of boxes; whether they have a flag for boxes"""
    of_box, optics = make_boxes(real), make_optics(camera, real) if camera else None
    Lens = make_lens(camera)
    at_lowpass, at_depth, at_edges, at_ray, at_plane, at_flag, at_ellipsoid_term = (
        layout.word(name)
        for name in ("lowpass_x", "z_numerator", "edge_u0", "nuz", "plane_z0", "boxed", "ellipsoid_term")
    )

    @wp.func
    def image_row(focal: real, offset: real, along: vec3, ahead: vec3) -> vec3:
        return focal * along + offset * ahead

    @wp.func
    def forms(
        a: vec3,  # scaled tangents
        b: vec3,
        unit_normal: vec3,
        offset: real,  # distance of the plane from the camera's centre, along the normal
        p: vec3,
        su: real,  # su sv: area of the tangents
        sv: real,
        center_x: real,
        center_y: real,
        in_front: bool,  # whether the centre is imaged
        boxed: bool,
        own_filter: bool,  # whether the splat is filtered by its own footprint
        thick: bool,
        inverse_m2: real,  # 1 / m^2 of a 3D Gaussian
        view: View,
        lens: Lens,
    ):
        """Fill the record except opacity, colour, box and fields of outputs; returns whether a ray intersects
        the splat."""
        record = words()
        fx, fy = real(view.focal_x), real(view.focal_y)
        # relative to the sample of the image that is nearest to the centre
        ax = wp.clamp(wp.floor(float(center_x)), 0.0, float(view.width - 1))
        ay = wp.clamp(wp.floor(float(center_y)), 0.0, float(view.height - 1))
        anchor_x, anchor_y = real(ax) + half, real(ay) + half
        k0, kx, ky, kz = vec3(), vec3(), vec3(), vec3()  # n_u, n_v, D: at the anchor, per x, per y, per z
        determinant = zero
        if wp.static(has_lens):
            # forms of a ray, not of a sample
            anchor = optics.anchor(int(ax), int(ay), in_front, p, view, lens)
            of_u, of_v, of_d = wp.cross(b, p), wp.cross(p, a), unit_normal * su * sv
            ray = vec3(real(anchor[0]), real(anchor[1]), real(anchor[2]))
            k0 = vec3(wp.dot(of_u, ray), wp.dot(of_v, ray), wp.dot(of_d, ray))
            kx, ky = vec3(of_u[0], of_v[0], of_d[0]), vec3(of_u[1], of_v[1], of_d[1])
            kz = vec3(of_u[2], of_v[2], of_d[2])
            determinant = su * sv * offset
        else:
            row_x, row_y, tw = vec3(a[0], b[0], p[0]), vec3(a[1], b[1], p[1]), vec3(a[2], b[2], p[2])
            if wp.static(parallel):
                tw = vec3(zero, zero, one)
            tu = image_row(fx, real(view.center_x) - anchor_x, row_x, tw)
            tv = image_row(fy, real(view.center_y) - anchor_y, row_y, tw)
            k0, kx, ky = wp.cross(tu, tv), wp.cross(tv, tw), wp.cross(tw, tu)
            determinant = fx * fy * su * sv * offset
            if wp.static(parallel):
                k0 = vec3(k0[0], k0[1], determinant)
        steepest = wp.max(wp.max(wp.abs(kx[0]), wp.abs(ky[0])), wp.max(wp.abs(kx[1]), wp.abs(ky[1])))
        if wp.static(has_lens):
            steepest = wp.max(steepest, wp.max(wp.abs(kz[0]), wp.abs(kz[1])))
        if wp.static(ewa):
            if thick:
                steepest = wp.abs(k0[2])  # D is 1 at all samples
        met = steepest > zero and steepest < real(wp.inf)
        scale = wp.where(determinant < zero, -one, one) / steepest
        n_scale = scale * sqrt_half
        # edge-on within rounding: no ray intersects the plane, and only the low-pass disc is rendered
        away = one
        if wp.static(not parallel):
            away = wp.sqrt(wp.dot(p, p))
        facing = wp.where(wp.abs(offset) > edge_on * away, scale, zero)
        z_numerator = determinant * facing  # the depth is z_numerator / D

        record[0] = float(k0[0] * n_scale)
        record[1] = float(kx[0] * n_scale)
        record[2] = float(ky[0] * n_scale)
        record[4] = float(k0[1] * n_scale)
        record[5] = float(kx[1] * n_scale)
        record[6] = float(ky[1] * n_scale)
        record[7] = float(z_numerator / real(view.near))
        record[8] = float(k0[2] * facing)
        record[9] = float(kx[2] * facing)
        record[10] = float(ky[2] * facing)
        record[11] = ax
        record[12] = ay
        if wp.static(edged):
            if boxed:
                of_u = of_box.edges(scale, kx[2], ky[2], kx[0], ky[0])
                of_v = of_box.edges(scale, kx[2], ky[2], kx[1], ky[1])
                record[at_edges] = of_u[0]
                record[at_edges + 1] = of_u[1]
                record[at_edges + 2] = of_v[0]
                record[at_edges + 3] = of_v[1]
        if wp.static(flagged):
            record[at_flag] = wp.where(boxed, 1.0, 0.0)
        if wp.static(has_lowpass_disc):
            # far away without a low-pass disc
            record[at_lowpass] = wp.where(in_front and not own_filter, float(center_x - anchor_x), 1.0e18)
            record[at_lowpass + 1] = wp.where(in_front, float(center_y - anchor_y), 1.0e18)
        if wp.static(exact):
            record[at_ellipsoid_term] = float(two * inverse_m2)
        if wp.static(parallel):
            # D times the depth
            record[7] = wp.inf
            record[at_plane] = float((a[2] * k0[0] + b[2] * k0[1] + p[2] * k0[2]) * facing)
            record[at_plane + 1] = float((a[2] * kx[0] + b[2] * kx[1]) * facing)
            record[at_plane + 2] = float((a[2] * ky[0] + b[2] * ky[1]) * facing)
            record[at_plane + 3] = float(view.near)
        if wp.static(has_lens):
            record[at_ray] = float(kz[0] * n_scale)
            record[at_ray + 1] = float(kz[1] * n_scale)
            record[at_ray + 2] = float(kz[2] * facing)
            record[at_ray + 3] = anchor[0]
            record[at_ray + 4] = anchor[1]
            record[at_ray + 5] = anchor[2]
        if wp.static(has_depth):
            record[at_depth] = float(z_numerator)
        return record, met

    return forms
