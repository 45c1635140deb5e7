"""Reinforcement learning by rsl-rl: the only room that imports torch."""

import threadpoolctl
import torch

# The networks are small: more threads gain little on a free machine, stall on a busy one, and
# change the rounding, and with it the result, from machine to machine. The physics has the cores.
torch.set_num_threads(1)
threadpoolctl.threadpool_limits(1, user_api="blas")  # numpy's
