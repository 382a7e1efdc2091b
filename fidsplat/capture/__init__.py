"""Capture settings of a frame as plain data: camera, outputs, quality, sensor, environment."""
