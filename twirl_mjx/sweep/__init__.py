"""Experiment grids: cells from data, what is missing of them, Ray to run it, tables of results."""
