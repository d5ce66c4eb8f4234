"""From sample tables to batches: what is read, in which order, and as which tensors."""
