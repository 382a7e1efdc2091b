"""Files, errors, interrupts, limits and timing, for all packages."""
