"""Rendering of scenes: renderer, frames, batches, several devices."""
