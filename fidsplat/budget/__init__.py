"""The cheapest quality that keeps an error, or the most accurate one that keeps a time (`Quality.within`)."""

from fidsplat.budget.choose import Choice, check_bounds, choose

__all__ = ["Choice", "check_bounds", "choose"]
