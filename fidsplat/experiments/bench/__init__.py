"""Benchmark of frame times: scenes, roofline model, suite of renderers, and kernel compilation in advance."""
