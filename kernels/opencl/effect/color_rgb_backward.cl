// One RGB colour per splat: one coefficient with derivative 1.
//@ functions
#define SH_COEFFICIENTS 1
#define IS_RGB 1
#define CLOUD_COEFFICIENTS 0
#define GRAD_COEFFICIENTS grad_colors
//@ color_backward
    splat_grad.basis[0] = 1;
    splat_grad.color[0] = (float)total.r;
    splat_grad.color[1] = (float)total.g;
    splat_grad.color[2] = (float)total.b;
