"""What a sensor makes of each pixel's light: exposure, vignetting, noise, gain, response, whole steps."""

from functools import cache

import warp as wp

from .common import STRICT, fma, struct_of

NUMBERS = {
    "exposure": {"exposure": wp.float32},
    "vignetting": {
        **{"center_x": wp.float32, "center_y": wp.float32, "per_radius": wp.float32},
        **{"fall_2": wp.float32, "fall_4": wp.float32, "fall_6": wp.float32},
    },
    "noise": {"shot_variance": wp.float32, "read_variance": wp.float32, "seed": wp.uint32},
    "gain": {"gain": wp.float32},
    "response_gamma": {"inverse_gamma": wp.float32},
    "response_srgb": {},
    "response_table": {"points": wp.int32},
    "quantise": {"steps": wp.float32},
}
"""what each step takes of a view, in the order of its uniforms"""
_FACTOR, _ADDED = wp.constant(wp.uint32(1664525)), wp.constant(wp.uint32(1013904223))
_LOW, _HALF = wp.constant(wp.uint32(0xFFFF)), wp.constant(wp.uint32(16))
_WORDS = wp.types.vector(4, wp.uint32)


@wp.func
def pcg4d(x: wp.uint32, y: wp.uint32, z: wp.uint32, w: wp.uint32) -> _WORDS:
    """Four hashed words of four counters (Jarzynski and Olano 2020, pcg4d)."""
    v = _WORDS(x, y, z, w) * _FACTOR
    for i in range(4):
        v[i] = v[i] + _ADDED
    for turn in range(2):
        v[0] = v[0] + v[1] * v[3]
        v[1] = v[1] + v[2] * v[0]
        v[2] = v[2] + v[0] * v[1]
        v[3] = v[3] + v[1] * v[2]
        if turn == 0:
            for i in range(4):
                v[i] = v[i] ^ (v[i] >> _HALF)
    return v


@wp.func
def variate(x: int, y: int, channel: int, seed: wp.uint32) -> float:
    """Of mean 0 and variance 1: twelve even 16-bit numbers, summed as integers, so that each device has the
    same.
    """
    total = int(0)
    for part in range(2):
        words = pcg4d(wp.uint32(x), wp.uint32(y), wp.uint32(2 * channel + part), seed)
        for i in range(4):
            if part == 0 or i < 2:
                total += int(words[i] & _LOW) + int(words[i] >> _HALF)
    return float(total - 6 * 65535) / 65536.0


@cache
def make_develop(steps: tuple[str, ...]):
    """The kernel that takes these steps, which stand in their order, and the struct of the numbers that they
    need.
    """
    fields = {name: kind for step in steps for name, kind in NUMBERS[step].items()}
    Settings = struct_of("Settings", "What the steps need.", fields)
    exposed, vignetted, noisy, amplified, gamma, srgb, table, quantised = (name in steps for name in NUMBERS)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def develop(
        first: int,  # pixel of thread 0
        s: Settings,
        response: wp.array(dtype=wp.float32),  # values at even steps from 0 to 1
        width: int,  # of the picture
        rgb: wp.array(dtype=wp.float32),  # (h w 3) in and out
    ):
        at = wp.tid() + first
        x, y = at % width, at / width
        shade = float(1.0)
        if wp.static(vignetted):
            across = (float(x) + 0.5 - s.center_x) * s.per_radius
            down = (float(y) + 0.5 - s.center_y) * s.per_radius
            r2 = fma(across, across, down * down)
            shade = wp.max(fma(r2, fma(r2, fma(r2, s.fall_6, s.fall_4), s.fall_2), 1.0), 0.0)
        for channel in range(3):
            v = rgb[3 * at + channel]
            if wp.static(exposed):
                v = v * s.exposure
            if wp.static(vignetted):
                v = v * shade
            if wp.static(noisy):
                deviation = wp.sqrt(fma(wp.max(v, 0.0), s.shot_variance, s.read_variance))
                v = fma(deviation, variate(x, y, channel, s.seed), v)
            if wp.static(amplified):
                v = v * s.gain
            if wp.static(gamma):
                v = wp.pow(wp.clamp(v, 0.0, 1.0), s.inverse_gamma)
            if wp.static(srgb):  # IEC 61966-2-1
                v = wp.clamp(v, 0.0, 1.0)
                if v <= 0.0031308:
                    v = 12.92 * v
                else:
                    v = 1.055 * wp.pow(v, 1.0 / 2.4) - 0.055
            if wp.static(table):
                place = wp.clamp(v, 0.0, 1.0) * float(s.points - 1)
                below = wp.min(int(place), s.points - 2)
                v = fma(place - float(below), response[below + 1] - response[below], response[below])
            if wp.static(quantised):
                v = wp.rint(wp.clamp(v, 0.0, 1.0) * s.steps) / s.steps
            rgb[3 * at + channel] = v

    return develop, Settings
