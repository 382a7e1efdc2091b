"""Splats as plain arrays: clouds, spherical harmonics, rotations."""
