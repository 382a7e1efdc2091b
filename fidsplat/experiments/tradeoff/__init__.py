"""Trade-off of accuracy and time: all quality settings, separately and combined, on standard scenes."""
