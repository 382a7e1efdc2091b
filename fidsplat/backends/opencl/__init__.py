"""The OpenCL backend: every stage in kernels (kernels/opencl), on any CPU or GPU that has a driver."""
