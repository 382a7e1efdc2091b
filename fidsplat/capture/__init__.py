"""Capture settings of a frame: camera, outputs, quality, sensor, environment; independent of the device."""
