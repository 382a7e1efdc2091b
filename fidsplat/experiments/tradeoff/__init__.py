"""Trade-off of accuracy and time: every quality setting, alone and in combinations, on standard scenes."""
