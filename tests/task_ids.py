"""Ids of the environments by the name of their task."""

import softmode

IDS = {name.partition("/")[2].rpartition("-v")[0]: name for name in softmode.ENVIRONMENTS}
"""For example "LiftSoft": "softmode/LiftSoft-v0"."""
