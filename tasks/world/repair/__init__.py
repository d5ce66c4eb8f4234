"""What is put right or left out between a log's files and its clips, the same for every data set."""
