"""Training: Algorithm 1, the learning curve, demonstrations, reuse of finished trainings."""
