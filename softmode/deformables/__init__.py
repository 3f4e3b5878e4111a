"""Reduced deformables: the build on the host, the step on the device.

This is the public path of the core. Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody
    from softmode.deformables.body.regions import Region
    from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
    from softmode.deformables.gradients.adjoint import AdjointOptions, AdjointReduced, ReducedGradients
    from softmode.deformables.gradients.adjoint_torch import rollout
    from softmode.deformables.materials.material import Material
    from softmode.deformables.materials.material_kernels import MaterialModel
    from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
    from softmode.deformables.model.status import status_reasons
    from softmode.deformables.model.velocities import set_velocity
    from softmode.deformables.quadrature.occupancy import Occupancy, fill_splats
    from softmode.deformables.quadrature.quadrature import (
        quadrature_from_box,
        quadrature_from_capsule,
        quadrature_from_points,
        quadrature_from_sphere,
        quadrature_from_splats,
    )
    from softmode.deformables.quadrature.quadrature_cuboids import with_integrator_points
    from softmode.deformables.quadrature.quadrature_density import quadrature_from_density
    from softmode.deformables.quadrature.quadrature_grid import Quadrature
    from softmode.deformables.quadrature.quadrature_implicit import quadrature_from_implicit
    from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh
    from softmode.deformables.reduction.build_body import build_body
    from softmode.deformables.reduction.cache import cached_body
    from softmode.deformables.reduction.cut import Cut, cut_body
    from softmode.deformables.reduction.eigenmodes import Eigenmodes, solve_eigenmodes
    from softmode.deformables.reduction.hold import carry_over, hold, paint
    from softmode.deformables.reduction.options import BuildOptions
    from softmode.deformables.reduction.patch import Patch
    from softmode.deformables.reduction.reduced_stiffness import elastic_modes
    from softmode.deformables.reduction.report import BodyReport, report_body
    from softmode.deformables.skinning.skin_splats import SkinSplats, average_basis
    from softmode.deformables.skinning.skinning_adjoint import AdjointSkinning
    from softmode.deformables.solver.attachments import Attachment, attach
    from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions
    from softmode.deformables.tools.energies import SoftEnergies
    from softmode.deformables.tools.grips import GripOptions, Grips, add_grip_slots
    from softmode.deformables.tools.inverse_map import InverseMap
    from softmode.deformables.tools.markers import Markers
    from softmode.deformables.tools.parameters import PARAMETER_FLAGS, ShapeFriction, set_parameters
    from softmode.deformables.tools.sensing import ContactSensor, ForceTorqueSensor, SurfacePressure

__all__ = [
    "PARAMETER_FLAGS",
    "AdjointOptions",
    "AdjointReduced",
    "AdjointSkinning",
    "Attachment",
    "BodyReport",
    "BuildOptions",
    "ContactSensor",
    "Cut",
    "Eigenmodes",
    "ForceTorqueSensor",
    "GripOptions",
    "Grips",
    "InverseMap",
    "Markers",
    "Material",
    "MaterialModel",
    "Occupancy",
    "Patch",
    "Quadrature",
    "ReducedBody",
    "ReducedGradients",
    "Region",
    "ShapeFriction",
    "SkinSplats",
    "SoftEnergies",
    "SolverCoupledReduced",
    "SolverReduced",
    "SolverReducedOptions",
    "SurfacePressure",
    "add_grip_slots",
    "add_pins",
    "add_reduced_body",
    "attach",
    "average_basis",
    "build_body",
    "cached_body",
    "carry_over",
    "cut_body",
    "elastic_modes",
    "fill_splats",
    "hold",
    "paint",
    "quadrature_from_box",
    "quadrature_from_capsule",
    "quadrature_from_density",
    "quadrature_from_implicit",
    "quadrature_from_mesh",
    "quadrature_from_points",
    "quadrature_from_sphere",
    "quadrature_from_splats",
    "register_custom_attributes",
    "report_body",
    "rollout",
    "set_parameters",
    "set_velocity",
    "solve_eigenmodes",
    "status_reasons",
    "with_integrator_points",
]

__getattr__, __dir__ = lazy_names(__name__)
