"""Kernels of all stages for NVIDIA Warp (CPU and CUDA), made by factories from the effects of a FeatureSet.

They implement the definition (docs/rendering.md) independently of the OpenCL kernels. Generated source
contains only the code of the requested effects: Warp evaluates `wp.static` conditions while it generates the
source.
"""
