"""What readers of all data sets share: clips out of logs, and files of strangers read as data (factory.datasets)."""
