"""`python -m factory failed out=<folder or URL>`: failed attempts: file, field, message, how to retry."""

from factory.commands.status import Request as Request
from factory.views.status import failed_lines, open_store


def main(request: Request) -> None:
    """Print every failed attempt."""
    print("\n".join(failed_lines(open_store(request.out))))
