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


def table(head: Sequence[str], rows: Sequence[Sequence[Html]], name: str) -> Html:
    """A table that scrolls sideways on a narrow screen."""
    top = el("thead", el("tr", *(el("th", title, scope="col") for title in head)))
    return el("div", el("table", top, el("tbody", *(el("tr", *row) for row in rows)), class_=name), class_="wide")


def number(value: int) -> Html:
    """A cell."""
    return el("td", f"{value:,}", class_="n")


def bar(rate: float, mark_percent: float | None = None) -> Html:
    """A share as a bar with its number; a mark where the published share would end."""
    if rate != rate:
        return el("span", "-", class_="dim")
    mark = (
        [el("i", style=f"left:{mark_percent:g}%", title=f"paper {mark_percent:g} %")]
        if mark_percent is not None
        else []
    )
    track = el("span", el("span", style=f"width:{100 * rate:.1f}%"), *mark, class_="track")
    return el("span", track, el("span", f"{100 * rate:.1f} %", class_="value"), class_="bar")


def count_bar(count: float, most: float, text: str | None = None) -> Html:
    """A count beside others; none is a dash."""
    if not count and text is None:
        return el("span", "-", class_="dim")
    share = 100 * count / most if most else 0.0
    track = el("span", el("span", style=f"width:{share:.1f}%"), class_="track")
    return el("span", track, el("span", text if text is not None else f"{count:,}", class_="value"), class_="bar count")


def nothing(text: str) -> Html:
    """Said where a list is empty."""
    return el("p", text, class_="nothing")
