// overdraw (h, w) int: fragments that the samples of a pixel draw. No output for users: `fidsplat bench` counts with it what a
// frame must blend.
//@ state
    vint overdraw;
//@ start
    pixel->overdraw = 0;
//@ fragment
    pixel->overdraw -= live;
//@ blend_args
    , global int *restrict overdraw_raw
//@ store
        VSTORE(pixel->overdraw, overdraw_raw + at);
//@ resolve_args
    , global const int *restrict overdraw_raw, global int *restrict overdraw_out
//@ resolve_start
    int overdraw = 0;
//@ resolve_sample
            overdraw += overdraw_raw[at];
//@ resolve_end
    overdraw_out[out] = overdraw;
