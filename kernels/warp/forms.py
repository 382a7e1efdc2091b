"""What a splat's record says of the rays that meet it: the affine forms that each sample evaluates.

A ray r = ((x - cx) / fx, (y - cy) / fy, 1) meets the plane of a splat with centre p, unit tangents t_u, t_v,
normal n at depth (n p) / (n r), and there u = (t_v x p) r / (s_u n r), v = (p x t_u) r / (s_v n r): from n x
(r x p) = r (n p) - p (n r). All three of n_u, n_v, D = n r are affine in the sample, and since p is
orthogonal to the first two, n_u and n_v vanish at the projected centre. They are scaled by one factor: D > 0
in front of the camera, the steepest slope is 1; n_u, n_v also by sqrt(1/2), so that (n_u^2 + n_v^2) / D^2 is
rho / 2.
"""

import math
from functools import cache

import warp as wp

from .boxes import make_boxes
from .common import View
from .ellipsoids import EXACT
from .lens import LENSES, make_lens, make_optics
from .records import BOXES, Layout


@cache
def make_forms(effects: tuple[str, ...], outputs: tuple[str, ...], real):
    """The function that fills a record of these effects and outputs."""
    layout = Layout(effects, outputs)
    vec2, vec3 = wp.types.vector(2, real), wp.types.vector(3, real)
    words = wp.types.vector(4 * layout.lines, wp.float32)
    sqrt_half, edge_on = real(math.sqrt(0.5)), real(1e-13 if real is wp.float64 else 1e-6)
    one, two, half, zero = real(1.0), real(2.0), real(0.5), real(0.0)
    has_depth, screen, parallel, exact = (
        name in effects for name in ("ray_depth", "lowpass_screen", "camera_orthographic", EXACT)
    )
    camera = next((name for name in effects if name in LENSES), None)
    bent = camera is not None
    edged = not bent and any(name in effects for name in BOXES)
    flagged = bent and "footprint_mixed" in effects
    """whether records say of a box where its edges are, or of any splat whether it is a box"""
    of_box, optics = make_boxes(real), make_optics(camera, real) if camera else None
    Lens = make_lens(camera)
    at_disc, at_depth, at_edges, at_ray, at_plane, at_flag, at_bulge = (
        layout.word(name)
        for name in ("disc_x", "z_numerator", "edge_u0", "nuz", "plane_z0", "boxed", "bulge")
    )

    @wp.func
    def forms(
        tangent_u: vec3,
        tangent_v: vec3,
        p: vec3,
        su: real,
        sv: real,
        center_x: real,
        center_y: real,
        in_front: bool,  # whether it is known where the centre falls
        boxed: bool,
        itself: bool,  # whether it is filtered by its own footprint
        inverse_m2: real,  # of an ellipsoid
        view: View,
        lens: Lens,
    ):
        """The record but for opacity, colour, box and what outputs add; the normal, and the camera's height
        above the plane; whether any ray meets the splat.
        """
        record = words()
        cx, cy = real(view.center_x), real(view.center_y)
        per_fx, per_fy = real(view.per_focal_x), real(view.per_focal_y)
        # about the sample of the picture that is nearest to the centre
        ax = wp.clamp(wp.floor(float(center_x)), 0.0, float(view.width - 1))
        ay = wp.clamp(wp.floor(float(center_y)), 0.0, float(view.height - 1))
        anchor_x, anchor_y = real(ax) + half, real(ay) + half
        normal = wp.cross(tangent_u, tangent_v)
        height = wp.dot(normal, p)  # of the camera's centre above the plane, with its side
        ray = vec3((anchor_x - cx) * per_fx, (anchor_y - cy) * per_fy, one)
        form_u = wp.cross(tangent_v, p) * (one / su)
        form_v = wp.cross(p, tangent_u) * (one / sv)
        if wp.static(parallel):
            # the same far away, per metre of distance: D is n_z
            height = normal[2]
            form_u = vec3(tangent_v[1], -tangent_v[0], zero) * (one / su)
            form_v = vec3(-tangent_u[1], tangent_u[0], zero) * (one / sv)
        if wp.static(bent):
            # forms of a ray, not of a sample
            anchor = optics.anchor(int(ax), int(ay), p, view, lens)
            ray = vec3(real(anchor[0]), real(anchor[1]), real(anchor[2]))
            per_fx, per_fy = one, one
        nux, nuy, nvx, nvy = form_u[0] * per_fx, form_u[1] * per_fy, form_v[0] * per_fx, form_v[1] * per_fy
        steepest = wp.max(wp.max(wp.abs(nux), wp.abs(nuy)), wp.max(wp.abs(nvx), wp.abs(nvy)))
        if wp.static(bent):
            steepest = wp.max(steepest, wp.max(wp.abs(form_u[2]), wp.abs(form_v[2])))
        met = steepest > zero and steepest < real(wp.inf)
        nu0, nv0 = wp.dot(form_u, ray), wp.dot(form_v, ray)
        if wp.static(not bent):
            if wp.static(parallel) or in_front:
                # both vanish at the projected centre
                nu0 = nux * (anchor_x - center_x) + nuy * (anchor_y - center_y)
                nv0 = nvx * (anchor_x - center_x) + nvy * (anchor_y - center_y)
        scale = wp.where(height < zero, -one, one) / steepest
        n_scale = scale * sqrt_half
        # edge-on within rounding: no ray meets the plane, only the low-pass disc is drawn
        away2 = wp.dot(p, p)
        if wp.static(parallel):
            away2 = one
        facing = wp.where(height * height > edge_on * edge_on * away2, scale, zero)

        record[0] = float(nu0 * n_scale)
        record[1] = float(nux * n_scale)
        record[2] = float(nuy * n_scale)
        record[4] = float(nv0 * n_scale)
        record[5] = float(nvx * n_scale)
        record[6] = float(nvy * n_scale)
        record[7] = float(height * facing * real(view.per_near))
        record[8] = float(wp.dot(normal, ray) * facing)
        record[9] = float(normal[0] * per_fx * facing)
        record[10] = float(normal[1] * per_fy * facing)
        record[11] = ax
        record[12] = ay
        if wp.static(edged):
            if boxed:
                of_d = vec2(normal[0] * per_fx, normal[1] * per_fy)
                if wp.static(parallel):
                    of_d = vec2(zero, zero)  # D is the same everywhere
                of_u = of_box.edges(of_d, vec2(nux, nuy), scale)
                of_v = of_box.edges(of_d, vec2(nvx, nvy), scale)
                record[at_edges] = of_u[0]
                record[at_edges + 1] = of_u[1]
                record[at_edges + 2] = of_v[0]
                record[at_edges + 3] = of_v[1]
        if wp.static(flagged):
            record[at_flag] = wp.where(boxed, 1.0, 0.0)
        if wp.static(screen):
            # far away if there is none
            record[at_disc] = wp.where(in_front and not itself, float(center_x - anchor_x), 1.0e18)
            record[at_disc + 1] = wp.where(in_front, float(center_y - anchor_y), 1.0e18)
        if wp.static(exact):
            record[at_bulge] = float(two * inverse_m2)
        if wp.static(parallel):
            # D times the depth, which is p_z - (n_x X + n_y Y) / n_z at (X, Y) from the centre [m]
            off_x, off_y = (anchor_x - center_x) * per_fx, (anchor_y - center_y) * per_fy
            record[7] = wp.inf
            record[8] = float(normal[2] * facing)
            record[9] = 0.0
            record[10] = 0.0
            record[at_plane] = float((normal[2] * p[2] - normal[0] * off_x - normal[1] * off_y) * facing)
            record[at_plane + 1] = float(-normal[0] * per_fx * facing)
            record[at_plane + 2] = float(-normal[1] * per_fy * facing)
            record[at_plane + 3] = float(view.near)
        if wp.static(bent):
            record[at_ray] = float(form_u[2] * n_scale)
            record[at_ray + 1] = float(form_v[2] * n_scale)
            record[at_ray + 2] = float(normal[2] * facing)
            record[at_ray + 3] = anchor[0]
            record[at_ray + 4] = anchor[1]
            record[at_ray + 5] = anchor[2]
        if wp.static(has_depth):
            record[at_depth] = float(height * facing)
        return record, normal, height, met

    return forms
