"""Vectorised worlds: a task in a scene under a dynamics, stepped by an engine."""
