"""One thread for every test: sums are then taken in the same order on every machine."""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import torch

torch.set_num_threads(1)
