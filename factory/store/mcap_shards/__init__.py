"""Samples as MCAP shards, a second form of the table `samples`: for tools that read MCAP and no Parquet."""
