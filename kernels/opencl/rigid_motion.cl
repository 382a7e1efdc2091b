// Rigid motion of a camera.

// Rotation matrix, row-major, of a rotation vector (Rodrigues' formula).
static inline void rotation_of(const real *vector, real *rotation) {
    real x = vector[0], y = vector[1], z = vector[2], square = x * x + y * y + z * z, angle = sqrt(square);
    // sine: sin(angle) / angle, cosine: (1 - cos(angle)) / angle^2
    real sine = angle > REAL(1e-4) ? sin(angle) / angle : 1 - square / 6;
    real cosine = angle > REAL(1e-4) ? (1 - cos(angle)) / square : REAL(0.5) - square / 24;
    rotation[0] = 1 - cosine * (y * y + z * z); rotation[1] = cosine * x * y - sine * z; rotation[2] = cosine * x * z + sine * y;
    rotation[3] = cosine * x * y + sine * z; rotation[4] = 1 - cosine * (x * x + z * z); rotation[5] = cosine * y * z - sine * x;
    rotation[6] = cosine * x * z - sine * y; rotation[7] = cosine * y * z + sine * x; rotation[8] = 1 - cosine * (x * x + y * y);
}

// Write `rotation`, `translation` and `eye`, the first members of a record View, after a motion: rotation vector and translation in camera
// axes. pose: rotation and translation before the motion.
static inline void move(const real *pose, const real *motion, global real *view) {
    real rotation[9];
    rotation_of(motion, rotation);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            view[3 * i + j] = rotation[3 * i] * pose[j] + rotation[3 * i + 1] * pose[3 + j] + rotation[3 * i + 2] * pose[6 + j];
        view[9 + i] = rotation[3 * i] * pose[9] + rotation[3 * i + 1] * pose[10] + rotation[3 * i + 2] * pose[11] + motion[3 + i];
    }
    for (int j = 0; j < 3; j++) view[12 + j] = -(view[j] * view[9] + view[3 + j] * view[10] + view[6 + j] * view[11]);
}
