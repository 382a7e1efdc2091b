"""The cheapest quality that keeps an error, or the most accurate that keeps a time: `fs.quality_within`."""

from fidsplat.budget.choose import Choice, certify, check_bounds, choose

__all__ = ["Choice", "certify", "check_bounds", "choose"]
