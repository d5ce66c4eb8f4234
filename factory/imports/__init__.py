"""Other people's samples and benchmarks as tables of ours."""
