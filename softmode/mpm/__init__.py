"""Differentiable material point method: particles and a grid, derivatives of a run, losses, morphs.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.mpm.grid import Grid
    from softmode.mpm.losses import MassLoss, position_loss
    from softmode.mpm.morphing import morph
    from softmode.mpm.options import MpmOptions
    from softmode.mpm.particles import ParticleBody, particles_from_body, particles_from_mesh, particles_from_shape
    from softmode.mpm.places import PlaceLoss
    from softmode.mpm.planner import MORPH_MATERIAL, MorphOptions, MorphPlanner
    from softmode.mpm.replaying import ReplayFrame, replay
    from softmode.mpm.run import MorphRun
    from softmode.mpm.shapes import GridShapes
    from softmode.mpm.simulation import MpmSimulation, ParameterBars, ParticleState

__all__ = [
    "MORPH_MATERIAL",
    "Grid",
    "GridShapes",
    "MassLoss",
    "MorphOptions",
    "MorphPlanner",
    "MorphRun",
    "MpmOptions",
    "MpmSimulation",
    "ParameterBars",
    "ParticleBody",
    "ParticleState",
    "PlaceLoss",
    "ReplayFrame",
    "morph",
    "particles_from_body",
    "particles_from_mesh",
    "particles_from_shape",
    "position_loss",
    "replay",
]

__getattr__, __dir__ = lazy_names(__name__)
