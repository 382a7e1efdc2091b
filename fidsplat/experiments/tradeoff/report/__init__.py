"""The report of `fidsplat tradeoff`. Nothing here decides what is measured:
results outlive its changes."""
