"""What is measured, one file per program and kind; `peers.serve` says what such a file holds."""
