import subprocess
import sys

import torch

from negopipe.peak_memory import peak_memory_bytes


def test_a_new_process_has_a_peak_of_its_own() -> None:
    """Not that of the process which started it, as `getrusage` says."""
    held = torch.ones(100_000_000)  # 400 MB
    code = "from negopipe.peak_memory import peak_memory_bytes; print(peak_memory_bytes())"
    small = int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert 5e6 < small < 2e8 < held.nbytes < peak_memory_bytes()
