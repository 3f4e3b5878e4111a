"""Soft objects: a body, its splats and its material, from files, stages and primitive shapes."""
