// overdraw (h, w) int: number of composited fragments of a pixel's samples, including each fragment of a layer. Internal; `fidsplat bench`
// reports it as the blending work of a frame.
//@ state
    vint overdraw;
//@ start
    pixel->overdraw = 0;
//@ attributes
    vint fragments;         // number of its fragments
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
