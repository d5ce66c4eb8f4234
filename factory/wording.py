"""Rates, times and errors as people say them."""

import re


def rate_text(per_s: float, what: str = "") -> str:
    """In the largest of 1/s, 1/min and 1/h that leaves at least one of them: 0.02 clips a second are 1.20 clips/min."""
    for unit, seconds in (("s", 1.0), ("min", 60.0), ("h", 3600.0)):
        if per_s * seconds >= 1.0:
            return f"{per_s * seconds:.2f}{what}/{unit}"
    return f"{per_s * 3600.0:.2f}{what}/h" if per_s > 0 else f"0{what}/s"


def time_text(seconds: float) -> str:
    """Seconds up to two minutes, then minutes, from two hours on both hours and minutes."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def one_line(error: BaseException) -> str:
    """What an error says, without a client's colours and line breaks."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error)).replace("\u21b3", ":")
    return " ".join(plain.split())[:300] or type(error).__name__
