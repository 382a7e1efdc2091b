// splat_id (h, w) int: index in the cloud of the splat with the maximum weight at the pixel; of equal weights the nearest. A
// coplanar layer is represented by its splat of maximum optical depth. -1 where alpha is below 1/255.
//@ project
    record.splat_id = splat_ids[i];
//@ state
    vfloat splat_id_weight;
    vint splat_id;
//@ start
    pixel->splat_id_weight = 0.0f;
    pixel->splat_id = -1;
//@ attributes
    vint splat_id;
//@ attribute_values
    attributes.splat_id = s->splat_id;
//@ layer_fields
    vfloat splat_id_tau;    // maximum optical depth of a fragment of the layer; the layer has its index
//@ layer_accumulate
    layer->mean.splat_id = VSELECT(layer->mean.splat_id, attributes->splat_id, VMASK(tau > layer->splat_id_tau));
    layer->splat_id_tau = fmax(layer->splat_id_tau, tau);
//@ composite
    vint heavier_id = VMASK(weight > pixel->splat_id_weight);
    pixel->splat_id = VSELECT(pixel->splat_id, attributes->splat_id, heavier_id);
    pixel->splat_id_weight = fmax(pixel->splat_id_weight, weight);
//@ store
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->splat_id_weight, pixel_covered(pixel)), splat_id_raw + at, stride);
        BLOCK_STORE(pixel->splat_id, splat_id_index_raw + at, stride);
//@ resolve_start
    float splat_id_weight = 0;
    int splat_id = -1;
//@ resolve_sample
            if (splat_id_raw[at] > splat_id_weight) {
                splat_id_weight = splat_id_raw[at];
                splat_id = splat_id_index_raw[at];
            }
//@ resolve_end
    splat_id_out[out] = splat_id;
//@ external_attributes
        attributes.splat_id = -1;
