"""Presets, level sets and primitives."""
