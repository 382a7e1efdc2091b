"""Experiments: the paper's tables and figures, the trade-off, the benchmark, the demo."""
