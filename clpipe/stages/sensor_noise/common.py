"""Parts that the methods of sensor noise share."""

NEVER_FULL = 1e30  # stands for no full well, in electrons or in signal units


def or_default(value: float | None, default: float) -> float:
    """The value, or the default for None."""
    return default if value is None else value
