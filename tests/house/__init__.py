"""Programs that measure the house itself: what a run gives, column by column, and what one clip's life runs through."""
