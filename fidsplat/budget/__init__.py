"""The cheapest quality that keeps an error, or the most accurate one that keeps a time."""
