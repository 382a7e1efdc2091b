"""Rendering of scenes: renderer, frames, several devices, flights, LiDAR scans, lighting of markers,
meshes.
"""
