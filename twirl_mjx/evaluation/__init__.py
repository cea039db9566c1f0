"""What is measured of a policy, and batched evaluation."""
