"""One file a command behind `python -m factory`, and the table that lists them."""
