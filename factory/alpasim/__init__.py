"""Scenes and traffic behind AlpaSim's contracts, and what every service on that wire needs."""
