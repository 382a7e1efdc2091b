"""Rendering scenes: the renderer, frames, batches, several devices."""
