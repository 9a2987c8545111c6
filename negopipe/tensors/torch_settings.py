"""torch's settings of the process: threads, default dtype and device, autograd, precision.

They are set for the duration of a call and restored afterwards. Other threads of the process see two of them meanwhile:
the default dtype and the precision.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch, for simulation without a network; then as many as before.

    The tensors of a simulation are too small to gain from more threads. On a machine with shared cores, threads that
    wait for each other made it six times slower. A forked process has none of its parent's threads and would wait for
    them for ever.
    """
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


@contextmanager
def own_settings() -> Iterator[None]:
    """Settings of the simulator, whatever the process has set; then those of the process again.

    They are one thread, float32 and the CPU as defaults of new tensors, exact float32 products, no autocast and no
    gradients. Inference mode is off, since its tensors could not be changed outside of it. Modes of torch's functions,
    among them the default device, have no effect inside.
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
