"""One folder a data set: its reader, its maps, what it is exported to and imported from."""
