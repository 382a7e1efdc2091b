// One RGB colour per splat: one coefficient with derivative 1.
//@ functions
#define SH_TERMS 1
#define PLAIN 1
#define CLOUD_TERMS 0
#define BY_TERMS grad_colors
//@ color_backward
    splat_grad.basis[0] = 1;
    splat_grad.color[0] = (float)total.r;
    splat_grad.color[1] = (float)total.g;
    splat_grad.color[2] = (float)total.b;
