"""Policies: what picks the prediction horizon. Tensors in, actions out; nothing of the simulator."""
