"""Rendering scenes larger than memory: culling, level of detail, residency."""
