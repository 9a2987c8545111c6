"""What the policy sees of the world."""
