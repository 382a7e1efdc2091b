// Gradient of the normalised sum w n.
//@ pixel_gradient
    vfloat normal_x, normal_y, normal_z;
//@ pixel_gradient_start
        vfloat nx = BLOCK_LOAD(normal_raw + at, stride), ny = BLOCK_LOAD(normal_raw + channel_stride + at, stride);
        vfloat nz = BLOCK_LOAD(normal_raw + 2 * (size_t)channel_stride + at, stride);
        vfloat normal_length = sqrt(nx * nx + ny * ny + nz * nz);
        vint has_normal = VMASK(normal_length > 0.0f);
        vfloat normal_scale = VSELECT((vfloat)0.0f, 1.0f / normal_length, has_normal);
        nx *= normal_scale; ny *= normal_scale; nz *= normal_scale;
        vfloat by_nx = pixels_of(by_normal, 3, 0, x, y, width, height), by_ny = pixels_of(by_normal, 3, 1, x, y, width, height);
        vfloat by_nz = pixels_of(by_normal, 3, 2, x, y, width, height), along = by_nx * nx + by_ny * ny + by_nz * nz;
        gradient->normal_x = (by_nx - along * nx) * normal_scale;
        gradient->normal_y = (by_ny - along * ny) * normal_scale;
        gradient->normal_z = (by_nz - along * nz) * normal_scale;
//@ by_weight
    by_weight = FMA(gradient->normal_x, (vfloat)s->nx, by_weight);
    by_weight = FMA(gradient->normal_y, (vfloat)s->ny, by_weight);
    by_weight = FMA(gradient->normal_z, (vfloat)s->nz, by_weight);
//@ sums
    vfloat nx, ny, nz;
//@ fragment_backward
    sums->nx = FMA(weight, gradient->normal_x, sums->nx);
    sums->ny = FMA(weight, gradient->normal_y, sums->ny);
    sums->nz = FMA(weight, gradient->normal_z, sums->nz);
//@ moments
    MOMENT(nx, sums->nx);
    MOMENT(ny, sums->ny);
    MOMENT(nz, sums->nz);
//@ facet_backward
        real towards = offset > 0 ? -1 : 1;
        real3_ by_facet = {towards * total.nx, towards * total.ny, towards * total.nz};
//@@ ellipsoid_normal_backward
        by_unit_a = add3(by_unit_a, cross3(unit_b, by_facet));
        by_unit_b = add3(by_unit_b, cross3(by_facet, unit_a));
