"""How a process runs: device, compiler, threads, workers, interruption, progress, which results are the same."""
