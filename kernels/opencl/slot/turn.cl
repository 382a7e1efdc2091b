// World to camera rotation, for what needs the world's axes when pixels are resolved.
//@ resolve_args
    , float turn_00, float turn_01, float turn_02, float turn_10, float turn_11, float turn_12, float turn_20, float turn_21
    , float turn_22
