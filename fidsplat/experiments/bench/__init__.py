"""Benchmark of frame times, kernel compilation in advance, scenes, and the roofline model of a frame."""
