"""Markup made by one function, which escapes whatever is not markup already.

A log id or an error message can so never become a tag, whoever writes the next section of the page.
"""

import html
from collections.abc import Sequence


class Html(str):
    """Text that is markup already."""


def el(tag: str, *children: object, **attributes: object) -> Html:
    """One element. Children that are not Html are escaped; `class_` is class, `data_x` is data-x, None is left out."""
    inner = "".join(child if isinstance(child, Html) else html.escape(str(child)) for child in children)
    named = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    return Html(f"<{tag}{named}>{inner}</{tag}>")


def join(parts: Sequence[Html], separator: str = "") -> Html:
    """Markup side by side."""
    return Html(separator.join(parts))
