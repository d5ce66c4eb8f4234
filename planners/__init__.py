"""The consumer: planners, co-training, evaluation. Samples are read through factory.store.reader."""
