"""What all compiled functions share: the decorator with its cache, trigonometry, threads, vectors."""
