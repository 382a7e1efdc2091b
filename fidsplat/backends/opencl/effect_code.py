"""Kernel code of effects and outputs: their files, and additions to structs and kernel arguments.

The projection computes in the type `real`, blending in `blend_real` (declare.ScalarTypes). D is the
denominator of the ray-splat intersection, the anchor the origin of a splat's sample coordinates
(kernel_interface.SPLAT).

Buffers are (channels, rows, columns) of the padded sample grid, unless a note has another shape.
"""

from __future__ import annotations

from fidsplat.backends.opencl.declare import EffectCode, SampleBuffer, args, member, uniforms
from fidsplat.backends.opencl.kernel_interface import RAY_UNIFORMS
from fidsplat.effects.extensions import Extension

_RAYS = args("in float rays  // 3 channels X, Y, Z; NaN outside the field of view")
_LENS_CAMERAS = ("camera_brown_conrady", "camera_fisheye", "camera_equirectangular")

EFFECT_CODE: dict[str, EffectCode] = {
    # effects: one of each kind
    "camera_pinhole": EffectCode("effect/camera_pinhole.cl", parts=("chord", "conic", "perspective")),
    "camera_brown_conrady": EffectCode(
        "effect/camera_brown_conrady.cl",
        parts=("perspective", "inverse_lens_lut", "rays"),
        view=(
            member("real lens[12]", "k1 to k6, p1, p2, s1 to s4"),
            member("real lens_fold", "squared radius where the polynomial stops being monotonic"),
        ),
    ),
    "camera_fisheye": EffectCode(
        "effect/camera_fisheye.cl",
        parts=("polygon", "inverse_lens_lut", "rays"),
        view=(member("real lens[4]", "k1 to k4"), member("real lens_limit", "half field of view [rad]")),
    ),
    "camera_equirectangular": EffectCode("effect/camera_equirectangular.cl", parts=("polygon", "rays")),
    "camera_orthographic": EffectCode(
        "effect/camera_orthographic.cl",
        parts=("chord", "conic"),
        splat=(member("blend_real z0 zx zy", "depth * D = z0 + zx x + zy y"), member("blend_real z_near")),
    ),
    "color_rgb": EffectCode(
        "effect/color_rgb.cl",
        project=args("cloud float colors  // (n, 3)"),
        backward_file="effect/color_rgb_backward.cl",
        project_backward=args("out float grad_colors  // (n, 3)"),
    ),
    "color_sh": EffectCode(
        "effect/color_sh.cl",
        project=args("cloud float sh  // (n, (SH_DEGREE + 1)^2, 3)"),
        backward_file="effect/color_sh_backward.cl",
        project_backward=args(
            "cloud float sh  // (n, (SH_DEGREE + 1)^2, 3)", "out float grad_sh  // the same shape"
        ),
    ),
    "lowpass_none": EffectCode("effect/lowpass_none.cl", backward_file="effect/lowpass_none_backward.cl"),
    "lowpass_pixel": EffectCode("effect/lowpass_pixel.cl", parts=("lowpass_none",)),
    "lowpass_screen": EffectCode(
        "effect/lowpass_screen.cl",
        splat=(
            member(
                "blend_real lowpass_x lowpass_y",
                "centre of the low-pass disc relative to the anchor pixel; far away if there is none",
            ),
        ),
        bounds=(
            member("float px py pr", "the filter's support: centre and radius [samples]; radius < 0: none"),
        ),
        backward_file="effect/lowpass_screen_backward.cl",
        record_gradient=(member("float lowpass_x lowpass_y", "with respect to the centre of the low-pass"),),
    ),
    # whether the fragment that crosses the early-termination threshold is composited
    "stop_inclusive": EffectCode(),
    "stop_exclusive": EffectCode(
        "effect/stop_exclusive.cl", backward_file="effect/stop_exclusive_backward.cl"
    ),
    # compositing order: of splats by their centres, or of fragments per pixel
    "order_centre": EffectCode("effect/order_centre.cl"),
    "order_pixel": EffectCode(
        "effect/order_pixel.cl",
        parts=("ray_depth",),
        splat=(member("blend_real nearest", "minimum depth of the splat's fragments"),),
    ),
    "order_coplanar": EffectCode("effect/order_coplanar.cl", parts=("order_centre", "coplanar_layers")),
    "order_coplanar_pixel": EffectCode(parts=("order_pixel", "coplanar_layers")),
    # a box is a splat with a hard-edged, rectangular footprint
    "footprint_gaussian": EffectCode(),
    "footprint_box": EffectCode("effect/footprint_box.cl", parts=("box_edges",)),
    "footprint_mixed": EffectCode(
        "effect/footprint_mixed.cl",
        parts=("box_edges",),
        splat=(member("int box"),),
        project=args("cloud int boxes  // (n) 1: box, 0: Gaussian"),
    ),
    "ellipsoid_exact": EffectCode(
        "effect/ellipsoid_exact.cl",
        parts=("thickness",),
        splat=(
            member(
                "blend_real ellipsoid_term",
                "thickness term: 2 / m^2, m: Mahalanobis distance of the camera; 0: a disk",
            ),
        ),
        backward_file="effect/ellipsoid_exact_backward.cl",
        record_gradient=(member("float ellipsoid_term"),),
    ),
    "ellipsoid_ewa": EffectCode(
        "effect/ellipsoid_ewa.cl",
        parts=("thickness",),
        view=(
            member(
                "real ewa_clamp[4]", "limits of -x, x, -y, y of the ray at which the projection is linearised"
            ),
        ),
        backward_file="effect/ellipsoid_ewa_backward.cl",
    ),
    "ellipsoid_ewa_antialiased": EffectCode(
        "effect/ellipsoid_ewa_antialiased.cl",
        parts=("ellipsoid_ewa",),
        backward_file="effect/ellipsoid_ewa_antialiased_backward.cl",
    ),
    # EWA projects all splats to disks that face the camera: D = 1, and n_u does not depend on rows
    "ellipsoids_only": EffectCode(
        "effect/ellipsoids_only.cl",
        constant=(
            *(
                ("nuy", "BLEND_REAL(0.0)"),
                ("d0", "BLEND_REAL(1.0)"),
                ("dx", "BLEND_REAL(0.0)"),
                ("dy", "BLEND_REAL(0.0)"),
            ),
            ("d_near", "INFINITY"),
        ),
    ),
    "background_constant": EffectCode(),
    "background_gradient": EffectCode(
        "effect/background_gradient.cl",
        parts=("world_ray",),
        composite_background=uniforms(
            "gradient", "float sky_r sky_g sky_b", "float ground_r ground_g ground_b", "float up_x up_y up_z"
        ),
    ),
    "background_panorama": EffectCode(
        "effect/background_panorama.cl",
        parts=("world_ray",),
        composite_background=args(
            uniforms("panorama_size", "int panorama_width panorama_height"),
            "array float panorama  // (panorama_height, panorama_width, 3)",
        ),
    ),
    "arithmetic_precise": EffectCode("effect/arithmetic_precise.cl"),
    "arithmetic_fast": EffectCode("effect/arithmetic_fast.cl"),
    # devices without a vendor dialect render `approximate` as `fast`
    "arithmetic_approximate": EffectCode("effect/arithmetic_fast.cl"),
    "motion_groups": EffectCode(
        "effect/motion_groups.cl",
        project=args("cloud int labels  // (n)", "in int moving  // number of groups, then their labels"),
    ),
    "external_depth": EffectCode(
        "effect/external_depth.cl",
        parts=("ray_depth",),
        blend=args(
            "array float external_depth external_rgb  // (h, w) infinite where there is none, (h, w, 3)",
            "array int external_label  // (h, w)",
        ),
    ),
    "shutter_exposure": EffectCode("effect/shutter_exposure.cl"),
    # bounding spheres of splats against the rows of a sub-frame
    "sub_frame_culling": EffectCode("effect/sub_frame_culling.cl"),
    "blend_double": EffectCode(),
    "blend_half": EffectCode(
        "effect/blend_half.cl",
        splat=(
            member(
                "uint rg b1",
                "(r, g) and (b, -1) in float16; blending adds weight * (b, -1) to (blue, transmittance)",
            ),
        ),
        packed=(("r", "WORDS_LOW({}rg)"), ("g", "WORDS_HIGH({}rg)"), ("b", "WORDS_LOW({}b1)")),
    ),
    "termination_depths": EffectCode(
        blend=args(
            "in uint keys",
            "out uint termination_depths  // of each tile: depth key at which blending stopped",
        )
    ),
    # parts that several effects share
    "chord": EffectCode("part/chord.cl"),  # columns of an ellipse in a range of rows
    "conic": EffectCode("part/conic.cl", replaced_by=(("ellipsoids_only", "conic_facing"),)),
    "conic_facing": EffectCode("part/conic_facing.cl"),  # disks that face the camera
    "perspective": EffectCode("part/perspective.cl"),
    "polygon": EffectCode("part/polygon.cl"),  # bounds of a disk by a circumscribed polygon
    "inverse_lens_lut": EffectCode(
        "part/inverse_lens_lut.cl",
        view=(
            member(
                "real lens_lut[6]",
                "`inverse_lens_lut`: low corner x, y; cells per unit along x, y; cells per side; first row",
            ),
        ),
        project=args(
            "in short4 inverse_lens_lut  // first, last column and row of the samples in each cell of rays"
        ),
    ),
    "rays": EffectCode(
        "part/rays.cl",
        splat=(
            member("blend_real nuz nvz dz", "n_u = nu0 + nux X + nuy Y + nuz Z, likewise n_v, D (SPLAT)"),
            member("blend_real ray_x ray_y ray_z", "X, Y, Z are relative to this ray"),
        ),
        project=_RAYS,
        blend=_RAYS,
        composite_background=_RAYS,
    ),
    "thickness": EffectCode(
        "part/thickness.cl",
        project=args("cloud float thickness  // (n) [m]; 0: a disk"),
        backward_file="part/thickness_backward.cl",
        project_backward=args(
            "cloud float thickness  // (n) [m]; 0: a disk", "out float grad_thickness  // (n)"
        ),
        project_step=args("out float activated_thickness"),
    ),
    "step_camera": EffectCode(
        "train/step_camera.cl",
        project_step=args("out real camera_sums  // (work-groups, 10) with respect to the camera"),
    ),
    "box_cover": EffectCode("part/box_cover.cl"),
    "box_edges": EffectCode(
        "part/box_edges.cl",
        parts=("box_cover",),
        splat=(
            member(
                "blend_real edge_u0 edge_u1 edge_v0 edge_v1",
                "1 / |grad| of the edge functions D + n_u, D - n_u, D + n_v, D - n_v",
            ),
        ),
        replaced_by=tuple((camera, "rays_box") for camera in _LENS_CAMERAS),
    ),
    "rays_box": EffectCode(
        "part/rays_box.cl",
        parts=("box_cover",),
        project=args("in float max_ray_derivative  // (1) maximum length of the derivative of a ray"),
        blend=args("in float ray_derivatives  // 6 channels dX/dx, dY/dx, dZ/dx, dX/dy, dY/dy, dZ/dy"),
    ),
    "ray_depth": EffectCode(
        "part/ray_depth.cl",
        splat=(
            member("blend_real z_numerator", "depth = z_numerator / D"),
            member("blend_real z_center z_reach", "depths are clamped to z_center +- z_reach"),
        ),
        backward_file="part/ray_depth_backward.cl",
        record_gradient=(member("float z_numerator z_center"),),
    ),
    "coplanar_layers": EffectCode(
        "part/coplanar_layers.cl",
        parts=("ray_depth",),
        splat=(member("int group", "coplanar group, -1: none"),),
        project=args("cloud int coplanar_groups  // (n) index of the splat's group; -1: none"),
    ),
    "tile_keys": EffectCode("part/tile_keys.cl", emit=args("in Splat splats")),
    "minimum_alpha": EffectCode("part/minimum_alpha.cl"),  # depth, normal and label require alpha >= 1/255
    "ray": EffectCode(resolve=RAY_UNIFORMS),
    "row_rotation": EffectCode(
        "part/row_rotation.cl", resolve=args("array float row_rotations  // (h, 3, 3)")
    ),
    # length of a ray per unit of depth along z, which converts depth to distance; 1 for fisheyes and
    # panoramas, whose depths are distances
    "pinhole_ray_length": EffectCode(
        "part/pinhole_ray_length.cl", replaced_by=(("camera_brown_conrady", "lens_ray_length"),)
    ),
    "lens_ray_length": EffectCode("part/lens_ray_length.cl"),
    "pinhole_sample_length": EffectCode(
        "part/pinhole_sample_length.cl",
        parts=("ray", "pinhole_ray_length"),
        replaced_by=(("camera_brown_conrady", "lens_sample_length"),),
    ),
    "lens_sample_length": EffectCode("part/lens_sample_length.cl", parts=("lens_ray_length",), resolve=_RAYS),
    "world_ray": EffectCode("part/world_ray.cl"),
    # outputs
    "alpha": EffectCode(
        "output/alpha.cl",
        backward_file="output/alpha_backward.cl",
        blend_backward=args("in float grad_alpha  // (h, w)"),
    ),
    "depth": EffectCode(
        "output/depth.cl",
        parts=("ray_depth", "minimum_alpha"),
        sample_buffers=(SampleBuffer("float", "depth_raw", 2, "sum w z, sum w"),),
        backward_file="output/depth_backward.cl",
        blend_backward=args("in float depth_raw  // 2 channels", "in float grad_depth  // (h, w)"),
    ),
    "distortion": EffectCode(
        "output/distortion.cl",
        parts=("ray_depth",),
        sample_buffers=(
            SampleBuffer("float", "distortion_raw", 4, "m of the first fragment; sums of w, w m, w m^2"),
        ),
        backward_file="output/distortion_backward.cl",
        blend_backward=args("in float distortion_raw  // 4 channels", "in float grad_distortion  // (h, w)"),
    ),
    "depth_median": EffectCode(
        "output/depth_median.cl",
        parts=("ray_depth", "minimum_alpha"),
        sample_buffers=(SampleBuffer("float", "depth_median_raw"),),
    ),
    "depth_first": EffectCode(
        "output/depth_first.cl",
        parts=("ray_depth",),
        blend=uniforms("first_hit_transmittance", "float first_hit_transmittance"),
        sample_buffers=(SampleBuffer("float", "depth_first_raw"),),
    ),
    "distance": EffectCode("output/distance.cl", parts=("depth", "pinhole_sample_length")),
    "distance_median": EffectCode(
        "output/distance_median.cl", parts=("depth_median", "pinhole_sample_length")
    ),
    "distance_first": EffectCode("output/distance_first.cl", parts=("depth_first", "pinhole_sample_length")),
    "normal": EffectCode(
        "output/normal.cl",
        parts=("minimum_alpha",),
        splat=(member("blend_real nx ny nz"),),
        sample_buffers=(SampleBuffer("float", "normal_raw", 3),),
        backward_file="output/normal_backward.cl",
        record_gradient=(member("float nx ny nz"),),
        blend_backward=args("in float normal_raw  // 3 channels", "in float grad_normal  // (h, w, 3)"),
    ),
    "normal_world": EffectCode("output/normal_world.cl", parts=("normal", "row_rotation")),
    "label": EffectCode(
        "output/label.cl",
        parts=("minimum_alpha",),
        splat=(member("int label"),),
        project=args("cloud int labels  // (n)"),
        sample_buffers=(SampleBuffer("float", "label_raw"), SampleBuffer("int", "label_id_raw")),
    ),
    "splat_id": EffectCode(
        "output/splat_id.cl",
        parts=("minimum_alpha",),
        splat=(member("int splat_id"),),
        project=args("cloud int splat_ids  // (n)"),
        sample_buffers=(SampleBuffer("float", "splat_id_raw"), SampleBuffer("int", "splat_id_index_raw")),
    ),
    "blended": EffectCode("output/blended.cl", sample_buffers=(SampleBuffer("int", "blended_raw"),)),
    # internal: number of composited fragments, for `fidsplat bench`; rounding bound, for the output `error`
    "overdraw": EffectCode("output/overdraw.cl", sample_buffers=(SampleBuffer("int", "overdraw_raw"),)),
    "rounding": EffectCode("output/rounding.cl", sample_buffers=(SampleBuffer("float", "rounding_raw"),)),
    # effects on the resolved rgb
    "fog": EffectCode(
        "output/fog.cl",
        parts=("ray_depth", "pinhole_ray_length"),
        blend=args(uniforms("fog_density", "float fog_density"), RAY_UNIFORMS),
        sample_buffers=(SampleBuffer("float", "fog_raw", averaged=True),),
    ),
    "decode_srgb": EffectCode("post/decode_srgb.cl"),
    "veiling_glare": EffectCode(
        "post/veiling_glare.cl",
        resolve=uniforms(
            "veiling_glare",
            "float glare_rest glare_r glare_g glare_b",
            note="value = glare_rest * value + glare; glare_rest: 1 - veiling glare",
        ),
    ),
    "exposure": EffectCode("post/exposure.cl", resolve=uniforms("exposure", "float exposure")),
    "vignetting": EffectCode(
        "post/vignetting.cl",
        resolve=args(
            uniforms(
                "vignette_center",
                "float vignette_x vignette_y vignette_scale",
                note="principal point [px], 1 / (half diagonal [px])",
            ),
            uniforms("vignetting", "float vignette_a vignette_b vignette_c"),
        ),
    ),
    "noise": EffectCode(
        "post/noise.cl",
        resolve=uniforms(
            "noise",
            "float shot_variance read_variance",
            "uint noise_seed",
            note="variances: of shot noise at value 1, of read noise at every value",
        ),
    ),
    "saturation": EffectCode("post/saturation.cl", resolve=uniforms("saturation", "float saturation")),
    "white_balance": EffectCode(
        "post/white_balance.cl", resolve=uniforms("white_balance", "float balance_r balance_g balance_b")
    ),
    "gain": EffectCode("post/gain.cl", resolve=uniforms("gain", "float gain")),
    "response_gamma": EffectCode(
        "post/response_gamma.cl", resolve=uniforms("inverse_gamma", "float inverse_gamma")
    ),
    "response_srgb": EffectCode("post/response_srgb.cl"),
    "response_table": EffectCode(
        "post/response_table.cl",
        resolve=args(
            uniforms("response_count", "int response_count"), "array float response  // (response_count)"
        ),
    ),
    "quantise": EffectCode("post/quantise.cl", resolve=uniforms("quantise_steps", "float quantise_steps")),
}
"""code of each effect, output and sensor step, and of the parts that several share"""


def extension_code(extension: Extension) -> EffectCode:
    """Code of an output or a sensor step of another package."""
    return EffectCode(
        str(extension.opencl),
        parts=extension.parts,
        sample_buffers=tuple(SampleBuffer("float", name) for name in extension.samples),
        resolve=uniforms(extension.name, *(f"float {name}" for name in extension.uniforms)),
    )
