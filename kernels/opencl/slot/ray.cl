// Intrinsics of the sample grid, for what needs a sample's ray when pixels are resolved. Pinhole rays.
//@ resolve_args
    , float ray_fx, float ray_fy, float ray_cx, float ray_cy
