"""Metric data sets from photographs or video: structure from motion, with scale and gravity from tags."""
