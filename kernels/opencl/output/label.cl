// label (h, w) int: label of the fragment or layer of maximum weight, the nearest of equals; -1 where alpha is below 1/255.
//@ project
    record.label = labels[i];
//@ state
    vfloat label_weight;
    vint label;
//@ start
    pixel->label_weight = 0.0f;
    pixel->label = -1;
//@ attributes
    vint label;
//@ attribute_values
    attributes.label = s->label;
//@ layer_fields
    vfloat label_tau;       // maximum optical depth of a fragment of the layer; the layer has its label
//@ layer_accumulate
    layer->mean.label = VSELECT(layer->mean.label, attributes->label, VMASK(tau > layer->label_tau));
    layer->label_tau = fmax(layer->label_tau, tau);
//@ composite
    vint heavier = VMASK(weight > pixel->label_weight);
    pixel->label = VSELECT(pixel->label, attributes->label, heavier);
    pixel->label_weight = fmax(pixel->label_weight, weight);
//@ store
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->label_weight, pixel_covered(pixel)), label_raw + at, stride);
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
//@ external_lane
            OPAQUE(int, attributes.label) = external_label[at];
