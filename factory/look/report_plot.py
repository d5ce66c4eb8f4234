"""Where candidates end, as an SVG: end poses over the interleaved grid, by what became of them."""

from collections.abc import Sequence
from dataclasses import dataclass

from factory.look.report_html import Html, el
from tasks.perturb import PerturbSettings

FATES = ("accepted", "rejected", "failed", "untried")


@dataclass(frozen=True)
class EndPoint:
    """A candidate's reached end pose, frame of the logged pose at T+H."""

    x_m: float
    y_m: float
    cell: tuple[int, int]
    fate: str  # of FATES


def scatter(points: Sequence[EndPoint], drawn: Sequence[EndPoint], grid: PerturbSettings) -> Html:
    """The SVG: longitudinal to the right, left of the log up; each axis has its own scale.

    Cells count all `points`; marks are made for `drawn`.
    """
    width, height, left, top, right, bottom = 1000.0, 420.0, 52.0, 12.0, 12.0, 44.0
    far, wide = grid.max_longitudinal_m, grid.max_lateral_m

    def u(x: float) -> float:
        return left + (x + far) / (2 * far) * (width - left - right)

    def v(y: float) -> float:
        return top + (wide - y) / (2 * wide) * (height - top - bottom)

    marks: list[Html] = []
    dx, dy = grid.step_longitudinal_m, grid.step_lateral_m
    reach_x, reach_y = int(far / dx + 0.5), int(wide / dy + 0.5)
    per_cell: dict[tuple[int, int], list[str]] = {}
    for point in points:
        per_cell.setdefault(point.cell, []).append(point.fate)
    for i in range(-reach_x, reach_x + 1):
        for j in range(-reach_y, reach_y + 1):
            if (i + j) % 2:
                continue
            x0, x1 = max(-far, (i - 0.5) * dx), min(far, (i + 0.5) * dx)
            y0, y1 = max(-wide, (j - 0.5) * dy), min(wide, (j + 0.5) * dy)
            fates = per_cell.get((i, j), [])
            text = (
                f"{i * dx:+g} m along, {j * dy:+g} m aside: {len(fates)} candidates, {fates.count('accepted')} accepted"
            )
            marks.append(_cell(u(x0), v(y1), u(x1) - u(x0), v(y0) - v(y1), text))
    marks.append(_line(u(0), v(-wide), u(0), v(wide)))
    marks.append(_line(u(-far), v(0), u(far), v(0)))
    for fate in reversed(FATES):
        marks += [_mark(u(p.x_m), v(p.y_m), fate) for p in drawn if p.fate == fate]
    for tick in range(-4, 5):
        x, y = tick * far / 4, tick * wide / 4
        marks.append(
            el("text", f"{x:+g}" if x else "0", x=f"{u(x):.1f}", y=f"{height - bottom + 18:.1f}", text_anchor="middle")
        )
        marks.append(el("text", f"{y:+g}" if y else "0", x=f"{left - 8:.1f}", y=f"{v(y) + 4:.1f}", text_anchor="end"))
    marks.append(
        el("text", "longitudinal [m]", x=f"{u(0):.1f}", y=f"{height - 6:.1f}", text_anchor="middle", class_="axis")
    )
    marks.append(
        el(
            "text",
            "lateral [m]",
            transform=f"translate(13 {v(0):.1f}) rotate(-90)",
            text_anchor="middle",
            class_="axis",
        )
    )
    return el(
        "div",
        el("svg", *marks, viewBox=f"0 0 {width:g} {height:g}", role="img", aria_label="end points of candidates"),
        class_="wide",
    )


def _line(x1: float, y1: float, x2: float, y2: float) -> Html:
    return el("line", x1=f"{x1:.1f}", y1=f"{y1:.1f}", x2=f"{x2:.1f}", y2=f"{y2:.1f}", class_="zero")


def _cell(x: float, y: float, width: float, height: float, text: str) -> Html:
    size = {"x": f"{x:.1f}", "y": f"{y:.1f}", "width": f"{width:.1f}", "height": f"{height:.1f}"}
    return el("rect", el("title", text), class_="cell", **size)


def _mark(x: float, y: float, fate: str) -> Html:
    """A disc, a cross, a square or a ring, so that the fates differ without colour too."""
    if fate == "rejected":
        return el("path", d=f"M{x - 3:.1f} {y - 3:.1f}l6 6m0 -6l-6 6", class_=f"mark {fate}")
    if fate == "failed":
        return el("rect", x=f"{x - 3:.1f}", y=f"{y - 3:.1f}", width=6, height=6, class_=f"mark {fate}")
    return el("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=4 if fate == "accepted" else 3, class_=f"mark {fate}")


def fate_mark(fate: str) -> Html:
    """The mark as a sign in running text."""
    return el("svg", _mark(7, 7, fate), width=14, height=14, viewBox="0 0 14 14", class_="inline")
