"""The batched rasteriser of splats, and its derivative."""
