"""Tests of softmode.radiance."""
