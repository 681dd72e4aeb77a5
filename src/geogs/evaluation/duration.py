"""Durations in words."""


def duration(seconds: int | float) -> str:
    """Format a time in seconds, minutes and hours."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.0f} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
