"""Memory layout of the records of visible splats."""

from collections.abc import Iterable

from . import output

_FORMS = (
    *("nu0", "nux", "nuy", "log_opacity"),
    *("nv0", "nvx", "nvy", "d_near"),
    *("d0", "dx", "dy", "ax"),
    *("ay", "r", "g", "b"),
)
# 1 / |gradient| of D + n_u, D - n_u, D + n_v, D - n_v; all 0: no box
_EDGES = ("edge_u0", "edge_u1", "edge_v0", "edge_v1")
BOXES = ("footprint_box", "footprint_mixed")
"""effects with boxes"""
_ALIGNED = {
    "camera_orthographic": ("plane_z0", "plane_zx", "plane_zy", "plane_near"),
    "rays": ("nuz", "nvz", "dz", "ray_x", "ray_y", "ray_z"),
}
_EXTRA = {
    "lowpass_screen": ("lowpass_x", "lowpass_y"),
    "ray_depth": ("z_numerator", "z_center", "z_reach"),
    "order_pixel": ("nearest",),
    "ellipsoid_exact": ("ellipsoid_term",),
}


class RecordLayout:
    """Memory layout of a record: number of vec4s (four floats, 16 bytes), and position of each number.

    nu0 + nux x + nuy y is n_u, likewise n_v and D, with x, y in samples relative to the centre of the anchor
    sample (ax, ay). Where the splat is beyond the near plane, D is at most d_near. lowpass_x, lowpass_y:
    projected centre relative to the anchor. z_numerator / D is the depth. columns and rows: [first, end) of
    the box of samples that the splat may overlap, 16 bits each. Behind a lens x, y, z are a sample's ray
    minus the anchor's ray (ray_x, ray_y, ray_z), and boxed is 1 for a box, else 0. For parallel rays
    plane_z0 + plane_zx x + plane_zy y is D times the depth, with a minimum of plane_near. ellipsoid_term:
    2 / m^2 of a 3D Gaussian (ellipsoids.py), else 0. Fields of outputs follow.
    """

    def __init__(self, effects: Iterable[str], outputs: Iterable[str] = ()) -> None:
        # fields that are loaded as a vec4 are first
        aligned = [name for effect in effects for name in _ALIGNED.get(effect, ())]
        extra = [name for effect in effects for name in _EXTRA.get(effect, ())]
        if "rays" not in effects:
            aligned += _EDGES if any(name in effects for name in BOXES) else ()
        elif "footprint_mixed" in effects:
            extra.append("boxed")
        extra += [name for file in outputs for name in output.declared(file).record]
        self.names = [*_FORMS, *aligned, "columns", "rows", *extra]
        self.vec4s = -(-len(self.names) // 4)

    def position(self, name: str) -> tuple[int, int]:
        """Index of the vec4 of a number, and of its component in the vec4; (0, 0) for a number that the
        record lacks, which no kernel reads."""
        return divmod(self.word(name), 4)

    def word(self, name: str) -> int:
        """Index of a number in the record; 0 for a number that the record lacks."""
        return self.names.index(name) if name in self.names else 0
