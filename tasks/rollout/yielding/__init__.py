"""Traffic that keeps the intent of its log and gives way where paths cross or merge (`traffic.yields`)."""
