"""Splats fitted to pictures."""
