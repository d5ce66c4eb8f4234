"""Who drives T+H..T+2H: one file is one expert."""
