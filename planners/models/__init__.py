"""The planners, a file or a folder each, and the parts that several share."""
