"""torch's settings belong to the process, not to a package: threads, default dtype and device, autograd, precision.

What is set here is set for as long as a call lasts. Other threads of the process see some of it meanwhile: the default
dtype and the precision.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch, then as many as before. For what simulates without a network.

    Its tensors are too small to gain from more threads, and on a machine whose cores others use as well, threads that
    wait for each other made it six times slower. A forked process has none of its parent's threads and would wait for
    them for ever; with one thread torch needs no other.
    """
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


@contextmanager
def own_settings() -> Iterator[None]:
    """The settings that the simulator is made for, whatever the process has set; then the process's own again.

    One thread, float32 and the CPU where a tensor is made without saying, exact float32 products, neither autocast nor
    gradients. Tensors of inference mode could not be changed outside of it, so it is off as well. Modes of
    torch's functions, among them the default device, do not reach inside.
    """
    product = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    dtype, precision = torch.get_default_dtype(), product.fp32_precision
    with (
        one_thread(),
        torch._C.DisableTorchFunction(),
        torch.inference_mode(False),
        torch.no_grad(),
        torch.autocast("cpu", enabled=False),
    ):
        torch.set_default_dtype(torch.float32)
        product.fp32_precision = "ieee"
        try:
            yield
        finally:
            torch.set_default_dtype(dtype)
            product.fp32_precision = precision
