// One RGB colour per splat: one coefficient with derivative 1.
//@ functions
#define SH_TERMS 1
#define PLAIN 1
#define CLOUD_TERMS 0
#define BY_TERMS by_colors
//@ color_backward
    own.basis[0] = 1;
    own.color[0] = (float)total.r;
    own.color[1] = (float)total.g;
    own.color[2] = (float)total.b;
