"""Where the pure tasks meet files: clips, scenes, pictures and rows, one stage after the other."""
