"""Scenes: a model with its solver, states, objects and cameras, and a captured step."""
