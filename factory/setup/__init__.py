"""A run put together from its settings: readers, vocabularies, experts, and what it will cost."""
