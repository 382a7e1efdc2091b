"""Files, errors, interrupts, limits and timing: what every package may import."""
