"""Rendering of scenes larger than device memory: culling, level of detail, chunk cache."""
