"""The table of docs/formats.md, from the declared columns."""

from collections.abc import Sequence

from factory.store.schema import FIELDS, Column


def formats_table(fields: Sequence[Column] = FIELDS, prefix: str = "") -> str:
    """The Markdown table of docs/formats.md."""
    head = "" if prefix else "| name | dtype | shape | unit | frame | null | what |\n|---|---|---|---|---|---|---|\n"
    lines = []
    for f in fields:
        shape = "x".join(map(str, f.shape)) or "-"
        null = "yes" if f.nullable else ("NaN" if f.nan else "")
        lines.append(f"| `{prefix}{f.name}` | {f.dtype} | {shape} | {f.unit} | {f.frame} | {null} | {f.about} |\n")
        if f.members:
            lines.append(formats_table(f.members, prefix=f"{f.name}."))
    return head + "".join(lines)
