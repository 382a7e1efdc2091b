"""The stages as Warp kernels (NVIDIA Warp, CPU and CUDA), made by factories that take a FeatureSet.

Written from the definition (docs/rendering.md), not from the OpenCL text, as an independent implementation.
What is absent from a FeatureSet is absent from the generated source: `wp.static` conditions are decided while
Warp writes it.
"""
