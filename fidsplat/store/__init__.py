"""Stores: splats on disk in chunks with bounding boxes and levels of detail (docs/large-scenes.md)."""
