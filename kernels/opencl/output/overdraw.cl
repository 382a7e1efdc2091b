// overdraw (h, w) int: fragments that the samples of a pixel draw, those of a layer when it is composited. No output for users:
// `fidsplat bench` counts with it what a frame must blend.
//@ state
    vint overdraw;
//@ start
    pixel->overdraw = 0;
//@ attributes
    vint fragments;         // that it is made of
//@ attribute_values
    attributes.fragments = 1;
//@ layer_accumulate
    layer->mean.fragments -= mask;
//@ composite
    pixel->overdraw += attributes->fragments & live;
//@ store
        BLOCK_STORE(pixel->overdraw, overdraw_raw + at, stride);
//@ resolve_start
    int overdraw = 0;
//@ resolve_sample
            overdraw += overdraw_raw[at];
//@ resolve_end
    overdraw_out[out] = overdraw;
