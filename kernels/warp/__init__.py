"""Kernels of all stages for NVIDIA Warp (CPU and CUDA), made by factories from the effects of a FeatureSet.

Written from the definition (docs/rendering.md), not from the OpenCL text, as an independent implementation.
Generated source contains only the code of the requested effects: Warp evaluates `wp.static` conditions while
it generates the source.
"""
