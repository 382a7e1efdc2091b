// blended (h, w) int: number of splats that were blended, those of a layer each by itself; of several samples the most.
//@ state
    vint blended;
//@ start
    pixel->blended = 0;
//@ seen
    vint blended;
//@ see
    seen.blended = 1;
//@ gather
    layer->mean.blended += VSELECT((vint)0, (vint)1, VMASK(opacity > 0.0f));
//@ composite
    pixel->blended += live & seen->blended;
//@ store
        BLOCK_STORE(pixel->blended, blended_raw + at, stride);
//@ resolve_start
    int blended = 0;
//@ resolve_sample
            blended = max(blended, blended_raw[at]);
//@ resolve_end
    blended_out[out] = blended;
//@ layer_seen
        seen.blended = 0;
