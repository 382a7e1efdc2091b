"""Scenes on disk: splats in chunks of a spatial order with bounds, levels of detail above them, and copies of
whole stores at other places (docs/large-scenes.md)."""
