// normal (h, w, 3): unit vector of the weighted mean of the splats' normals, in the camera frame, towards the camera; 0 where alpha is
// below 1/255.
//@ project
//@@ ellipsoid_normal
    // one sign per splat, since the camera is on one side of the complete plane
    real towards = offset > 0 ? -1 : 1;
    record.nx = (blend_real)(unit_normal.x * towards);
    record.ny = (blend_real)(unit_normal.y * towards);
    record.nz = (blend_real)(unit_normal.z * towards);
//@ state
    vfloat normal_x, normal_y, normal_z;
//@ start
    pixel->normal_x = 0.0f;
    pixel->normal_y = 0.0f;
    pixel->normal_z = 0.0f;
//@ attributes
    vfloat nx, ny, nz;
//@ attribute_values
    attributes.nx = s->nx;
    attributes.ny = s->ny;
    attributes.nz = s->nz;
//@ layer_accumulate
    layer->mean.nx = FMA(share, attributes->nx - layer->mean.nx, layer->mean.nx);
    layer->mean.ny = FMA(share, attributes->ny - layer->mean.ny, layer->mean.ny);
    layer->mean.nz = FMA(share, attributes->nz - layer->mean.nz, layer->mean.nz);
//@ composite
    pixel->normal_x = FMA(weight, attributes->nx, pixel->normal_x);
    pixel->normal_y = FMA(weight, attributes->ny, pixel->normal_y);
    pixel->normal_z = FMA(weight, attributes->nz, pixel->normal_z);
//@ store
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->normal_x, pixel_covered(pixel)), normal_raw + at, stride);
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->normal_y, pixel_covered(pixel)), normal_raw + channel_stride + at, stride);
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->normal_z, pixel_covered(pixel)), normal_raw + 2 * channel_stride + at, stride);
//@ resolve_start
    float normal_x = 0, normal_y = 0, normal_z = 0;
//@ resolve_sample
            normal_x += normal_raw[at];
            normal_y += normal_raw[channel_stride + at];
            normal_z += normal_raw[2 * (size_t)channel_stride + at];
//@ resolve_end
    float normal_length = sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z);
    float normal_scale = normal_length > 0 ? 1.0f / normal_length : 0.0f;
    normal_out[3 * out] = normal_x * normal_scale;
    normal_out[3 * out + 1] = normal_y * normal_scale;
    normal_out[3 * out + 2] = normal_z * normal_scale;
//@ external_attributes
        attributes.nx = attributes.ny = attributes.nz = 0.0f;
