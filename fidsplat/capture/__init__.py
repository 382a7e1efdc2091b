"""How an image is taken: camera, outputs, quality, sensor, environment; plain data."""
