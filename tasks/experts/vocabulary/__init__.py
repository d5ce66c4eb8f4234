"""The sampling expert: the best of a vocabulary, with the reward as its judge."""
