// Shared by loss.cl (GPUs) and loss_strips.cl (CPUs): the training loss (1 - w) L1 + w (1 - SSIM) and its gradient with respect to each value.
// NumPy reference with formulas: fidsplat/train/losses.py.
//
// An image is rows of `stride` floats with interleaved channels, with MARGIN_ROWS rows and MARGIN floats of zeros around it, so
// that windows that overlap its edge read zeros without a test.

#define RADIUS 5
#define MARGIN_ROWS RADIUS
#define MARGIN 16  // at least three channels of RADIUS pixels

constant float WINDOW[2 * RADIUS + 1] = {
    0.00102838012f, 0.00759875821f, 0.0360007733f, 0.109360687f, 0.213005543f, 0.266011715f,
    0.213005543f, 0.109360687f, 0.0360007733f, 0.00759875821f, 0.00102838012f,
};
#define C1 1e-4f
#define C2 9e-4f

// 0 for values behind the last column.
#define INSIDE(v) VSELECT((vfloat)(0.0f), v, VMASK((vfloat)((float)column) + VLANE < (vfloat)((float)width)))

// SSIM of a window's means, and its gradients with respect to the means of a, a a and a b.
typedef struct {
    vfloat ssim, grad_mean, grad_variance, grad_shared;
} Ssim;

static inline Ssim ssim_of(vfloat a, vfloat b, vfloat aa, vfloat bb, vfloat ab) {
    Ssim result;
    vfloat means = a * a + b * b + C1, variances = (aa - a * a) + (bb - b * b) + C2;
    vfloat top = 2.0f * a * b + C1, shared = 2.0f * (ab - a * b) + C2;
    result.ssim = top * shared / (means * variances);
    result.grad_shared = 2.0f * top / (means * variances);
    result.grad_variance = -result.ssim / variances;
    vfloat grad_mean = 2.0f * (b * shared - a * result.ssim * variances) / (means * variances);
    result.grad_mean = grad_mean - (2.0f * a * result.grad_variance + b * result.grad_shared);
    return result;
}
