"""The machine: what a run has to do, and how it is done once, in this process or on a cluster."""
