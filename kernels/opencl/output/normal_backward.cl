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
        vfloat grad_nx = pixels_of(grad_normal, 3, 0, x, y, width, height), grad_ny = pixels_of(grad_normal, 3, 1, x, y, width, height);
        vfloat grad_nz = pixels_of(grad_normal, 3, 2, x, y, width, height), along = grad_nx * nx + grad_ny * ny + grad_nz * nz;
        gradient->normal_x = (grad_nx - along * nx) * normal_scale;
        gradient->normal_y = (grad_ny - along * ny) * normal_scale;
        gradient->normal_z = (grad_nz - along * nz) * normal_scale;
//@ grad_weight
    grad_weight = FMA(gradient->normal_x, (vfloat)s->nx, grad_weight);
    grad_weight = FMA(gradient->normal_y, (vfloat)s->ny, grad_weight);
    grad_weight = FMA(gradient->normal_z, (vfloat)s->nz, grad_weight);
//@ sums
    vfloat nx, ny, nz;
//@ fragment_backward
    sums->nx = FMA(weight, gradient->normal_x, sums->nx);
    sums->ny = FMA(weight, gradient->normal_y, sums->ny);
    sums->nz = FMA(weight, gradient->normal_z, sums->nz);
//@ record_gradients
    STORE_SUM(nx, sums->nx);
    STORE_SUM(ny, sums->ny);
    STORE_SUM(nz, sums->nz);
//@ unit_normal_backward
        real towards = offset > 0 ? -1 : 1;
        real3_ grad_unit_normal = {towards * total.nx, towards * total.ny, towards * total.nz};
//@@ ellipsoid_normal_backward
        grad_unit_a = add3(grad_unit_a, cross3(unit_b, grad_unit_normal));
        grad_unit_b = add3(grad_unit_b, cross3(grad_unit_normal, unit_a));
