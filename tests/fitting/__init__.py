"""Tests of `softmode.fitting`."""
