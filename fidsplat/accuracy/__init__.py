"""Errors of images, their prices in time, and the quality that fits a bound."""
