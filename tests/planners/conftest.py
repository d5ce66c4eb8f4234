"""Tests run side by side, one core each: more threads than that make small networks many times slower."""

import torch

torch.set_num_threads(1)
