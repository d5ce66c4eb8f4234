"""What a user says: words of a command line, the groups of conf/, their composition and checks."""
