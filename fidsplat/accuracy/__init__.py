"""Errors of images, their cost in time, and the choice of a quality within a bound."""
