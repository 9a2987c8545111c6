"""The stages of a run: train, evaluate and report need each other in this order, the others stand alone."""
