"""Rendering by worker processes on other machines."""
