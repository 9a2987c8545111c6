"""negopipe beside its peers in one run: python -m negopipe.benchmark.peers; docs/peers.md says what is compared."""
