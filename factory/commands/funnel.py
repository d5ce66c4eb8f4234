"""`python -m factory funnel out=<folder or URL>`: acceptance by expert and round, and why the rest was not."""

from factory.commands.status import Request as Request
from factory.views.status import funnel_text, open_store


def main(request: Request) -> None:
    """Print the table."""
    print(funnel_text(open_store(request.out)))
