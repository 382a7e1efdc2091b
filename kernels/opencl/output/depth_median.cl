// depth_median (h, w): depth [m] of the last fragment with transmittance above 1/2 in front of it; 0 where alpha is below 1/255.
// Consecutive fragments of weight below 1/255 count together, at the depth of the fragment at which their sum reaches it. For a pixel:
// the lower median over its samples that have one.
//@ state
    vfloat depth_median;
    vfloat median_transmittance;    // transmittance behind the last represented fragment
//@ start
    pixel->depth_median = 0.0f;
    pixel->median_transmittance = 1.0f;
//@ composite
    vfloat behind = pixel->t - weight;
    vint counts = live & VMASK(pixel->t > 0.5f) & VMASK(pixel->median_transmittance - behind >= MIN_ALPHA);
    pixel->depth_median = VSELECT(pixel->depth_median, attributes->z, counts);
    pixel->median_transmittance = VSELECT(pixel->median_transmittance, behind, counts);
//@ store
        BLOCK_STORE(pixel->depth_median, depth_median_raw + at, stride);
//@ resolve_start
    float depth_medians[SAMPLES * SAMPLES];
    int depth_median_hits = 0;
//@ resolve_sample
            float median_here = depth_median_raw[at];
            if (median_here > 0.0f) {
                int index = depth_median_hits++;
                for (; index > 0 && depth_medians[index - 1] > median_here; index--)
                    depth_medians[index] = depth_medians[index - 1];
                depth_medians[index] = median_here;
            }
//@ resolve_end
    depth_median_out[out] = depth_median_hits > 0 ? depth_medians[(depth_median_hits - 1) / 2] : 0.0f;
