// label (h, w) int: label of the fragment or layer with the largest weight, the nearest of equals; -1 where less
// than 1/255 is covered.
//@ project
    record.label = labels[i];
//@ state
    vfloat label_weight;
    vint label;
//@ start
    pixel->label_weight = 0.0f;
    pixel->label = -1;
//@ seen
    vint label;
//@ see
    seen.label = s->label;
//@ layer
    vfloat label_tau;       // greatest optical depth of its fragments: that one's label is the layer's
//@ gather
    layer->mean.label = VSELECT(layer->mean.label, seen->label, VMASK(tau > layer->label_tau));
    layer->label_tau = fmax(layer->label_tau, tau);
//@ composite
    vint heavier = VMASK(weight > pixel->label_weight);
    pixel->label = VSELECT(pixel->label, seen->label, heavier);
    pixel->label_weight = fmax(pixel->label_weight, weight);
//@ store
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->label_weight, pixel_shown(pixel)), label_raw + at, stride);
        BLOCK_STORE(pixel->label, label_id_raw + at, stride);
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
//@ layer_lane
            OPAQUE(int, seen.label) = layer_label[at];
