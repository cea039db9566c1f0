"""What leaves the training machine: exported policies, rehearsals and pictures."""
