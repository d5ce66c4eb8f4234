"""The table of docs/formats.md, from the declared columns."""

from collections.abc import Sequence
from itertools import groupby

from factory.store.schema import FIELDS, Column


def formats_table(fields: Sequence[Column] = FIELDS, prefix: str = "") -> str:
    """The Markdown table of docs/formats.md; columns side by side that differ by name alone share a line."""
    head = "" if prefix else "| name | dtype | shape | unit | frame | null | what |\n|---|---|---|---|---|---|---|\n"
    lines = []
    for (says, members), alike in groupby(fields, key=lambda f: (said_of(f), f.members)):
        names = ", ".join(f"`{prefix}{f.name}`" for f in alike)
        lines.append(f"| {names} | {says} |\n")
        if members:
            lines.append(formats_table(members, prefix=names.strip("`") + "."))
    return head + "".join(lines)


def said_of(column: Column) -> str:
    """All cells of a column's line but its name."""
    shape = "x".join(map(str, column.shape)) or "-"
    null = "yes" if column.nullable else ("NaN" if column.nan else "")
    return f"{column.dtype} | {shape} | {column.unit} | {column.frame} | {null} | {column.about}"
