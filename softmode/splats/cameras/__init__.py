"""Cameras that draw deforming splats, meshes, light and shadow."""
