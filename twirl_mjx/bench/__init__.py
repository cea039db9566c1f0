"""Measurements of this machine: learner, worlds, start-up and one training epoch."""
