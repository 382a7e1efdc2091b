"""Photographs to a metric data set: frames of a video, structure from motion, scale and gravity from tags."""
