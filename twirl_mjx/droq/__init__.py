"""The learner: DroQ networks, losses and updates."""
