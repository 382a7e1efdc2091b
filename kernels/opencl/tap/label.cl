// label (h, w) int: label of the fragment with the largest weight, the nearest of equals; -1 where nothing was drawn.
//@ record
    int label;
//@ project_args
    , global const int *restrict labels      // (n)
//@ project
    record.label = labels[i];
//@ state
    vfloat label_weight;
    vint label;
//@ start
    pixel->label_weight = 0.0f;
    pixel->label = -1;
//@ fragment
    vint heavier = VMASK(weight > pixel->label_weight);
    pixel->label = VSELECT(pixel->label, (vint)s->label, heavier);
    pixel->label_weight = fmax(pixel->label_weight, weight);
//@ blend_args
    , global float *restrict label_raw, global int *restrict label_id_raw
//@ store
        VSTORE(pixel->label_weight, label_raw + at);
        VSTORE(pixel->label, label_id_raw + at);
//@ resolve_args
    , global const float *restrict label_raw, global const int *restrict label_id_raw, global int *restrict label_out
//@ resolve_start
    float label_weight = 0;
    int label = -1;
//@ resolve_sample
            if (label_raw[at] > label_weight) {
                label_weight = label_raw[at];
                label = label_id_raw[at];
            }
//@ resolve_end
    label_out[out] = label;
