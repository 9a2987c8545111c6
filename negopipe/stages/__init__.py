"""The stages of a run: train, evaluate and report need each other in this order, replay needs evaluate,
the others stand alone."""
