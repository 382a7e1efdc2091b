// distance_median (h, w): distance along the ray [m] of depth_median; the lower median over a pixel's samples.
//@ resolve_start
    float medians_along[SAMPLES * SAMPLES];
    int medians_hit = 0;
//@ resolve_sample
            float along_here = depth_median_raw[at] * length_here;
            if (along_here > 0.0f) {
                int index = medians_hit++;
                for (; index > 0 && medians_along[index - 1] > along_here; index--) medians_along[index] = medians_along[index - 1];
                medians_along[index] = along_here;
            }
//@ resolve_end
    distance_median_out[out] = medians_hit > 0 ? medians_along[(medians_hit - 1) / 2] : 0.0f;
