// Corners of the regular POLYGON-gon around a disk by rotation, without a cosine for each.
//@ polygon
#define POLYGON_INNER REAL(0.98078528040323044913)   // cos(pi / POLYGON)
static inline void next_corner(real *u, real *v) {
    const real c = REAL(0.92387953251128675613), s = REAL(0.38268343236508977173);   // of the angle 2 pi / POLYGON
    real before = *u;
    *u = c * before - s * *v;
    *v = s * before + c * *v;
}
typedef char polygon_has_the_sides_that_its_constants_say[POLYGON == 16 ? 1 : -1];
