// blended (h, w) int: number of composited fragments, including each fragment of a layer; the maximum over a pixel's samples.
//@ state
    vint blended;
//@ start
    pixel->blended = 0;
//@ attributes
    vint blended;
//@ attribute_values
    attributes.blended = 1;
//@ layer_accumulate
    layer->mean.blended += VSELECT((vint)0, (vint)1, VMASK(alpha > 0.0f));
//@ composite
    pixel->blended += live & attributes->blended;
//@ store
        BLOCK_STORE(pixel->blended, blended_raw + at, stride);
//@ resolve_start
    int blended = 0;
//@ resolve_sample
            blended = max(blended, blended_raw[at]);
//@ resolve_end
    blended_out[out] = blended;
//@ external_attributes
        attributes.blended = 0;
