"""How a process runs: device, compiler, threads, workers, interruption, progress, identity of results."""
