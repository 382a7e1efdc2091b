"""Utilities of all packages: arguments, files, errors, interrupts, limits and timing."""
