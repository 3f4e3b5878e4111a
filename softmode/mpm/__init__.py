"""Differentiable material point method: particles and a grid, derivatives of a run, losses, morphs.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.mpm.grid import Grid as Grid
    from softmode.mpm.losses import MassLoss as MassLoss
    from softmode.mpm.losses import position_loss as position_loss
    from softmode.mpm.morphing import morph as morph
    from softmode.mpm.options import MpmOptions as MpmOptions
    from softmode.mpm.particles import ParticleBody as ParticleBody
    from softmode.mpm.particles import particles_from_body as particles_from_body
    from softmode.mpm.particles import particles_from_mesh as particles_from_mesh
    from softmode.mpm.particles import particles_from_shape as particles_from_shape
    from softmode.mpm.places import PlaceLoss as PlaceLoss
    from softmode.mpm.planner import MORPH_MATERIAL as MORPH_MATERIAL
    from softmode.mpm.planner import MorphOptions as MorphOptions
    from softmode.mpm.planner import MorphPlanner as MorphPlanner
    from softmode.mpm.replaying import ReplayFrame as ReplayFrame
    from softmode.mpm.replaying import replay as replay
    from softmode.mpm.run import MorphRun as MorphRun
    from softmode.mpm.shapes import GridShapes as GridShapes
    from softmode.mpm.simulation import MpmSimulation as MpmSimulation
    from softmode.mpm.simulation import ParameterBars as ParameterBars
    from softmode.mpm.simulation import ParticleState as ParticleState
    from softmode.mpm.solver_coupled import SolverCoupledParticles as SolverCoupledParticles

__getattr__, __dir__ = lazy_names(__name__)
