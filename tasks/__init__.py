"""The science: pure stages. Knows no Ray, no files, no configuration library; importing it needs numpy only."""

__version__ = "0.2.0"
