"""Reduced deformables: the build on the host, the step on the device.

This is the public path of the core. Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.deformables.body.reduced_body import ReducedBody as ReducedBody
    from softmode.deformables.body.regions import Region as Region
    from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced as SolverCoupledReduced
    from softmode.deformables.gradients.adjoint import AdjointOptions as AdjointOptions
    from softmode.deformables.gradients.adjoint import AdjointReduced as AdjointReduced
    from softmode.deformables.gradients.adjoint import ReducedGradients as ReducedGradients
    from softmode.deformables.gradients.adjoint_torch import rollout as rollout
    from softmode.deformables.materials.material import Material as Material
    from softmode.deformables.materials.material_kernels import MaterialModel as MaterialModel
    from softmode.deformables.model.authoring import add_pins as add_pins
    from softmode.deformables.model.authoring import add_reduced_body as add_reduced_body
    from softmode.deformables.model.authoring import register_custom_attributes as register_custom_attributes
    from softmode.deformables.model.status import status_reasons as status_reasons
    from softmode.deformables.model.velocities import set_velocity as set_velocity
    from softmode.deformables.quadrature.occupancy import Occupancy as Occupancy
    from softmode.deformables.quadrature.occupancy import fill_splats as fill_splats
    from softmode.deformables.quadrature.quadrature import quadrature_from_box as quadrature_from_box
    from softmode.deformables.quadrature.quadrature import quadrature_from_capsule as quadrature_from_capsule
    from softmode.deformables.quadrature.quadrature import quadrature_from_points as quadrature_from_points
    from softmode.deformables.quadrature.quadrature import quadrature_from_sphere as quadrature_from_sphere
    from softmode.deformables.quadrature.quadrature import quadrature_from_splats as quadrature_from_splats
    from softmode.deformables.quadrature.quadrature_cuboids import with_integrator_points as with_integrator_points
    from softmode.deformables.quadrature.quadrature_density import quadrature_from_density as quadrature_from_density
    from softmode.deformables.quadrature.quadrature_grid import Quadrature as Quadrature
    from softmode.deformables.quadrature.quadrature_implicit import quadrature_from_implicit as quadrature_from_implicit
    from softmode.deformables.quadrature.quadrature_mesh import quadrature_from_mesh as quadrature_from_mesh
    from softmode.deformables.reduction.build_body import build_body as build_body
    from softmode.deformables.reduction.cache import cached_body as cached_body
    from softmode.deformables.reduction.cut import Cut as Cut
    from softmode.deformables.reduction.cut import cut_body as cut_body
    from softmode.deformables.reduction.eigenmodes import Eigenmodes as Eigenmodes
    from softmode.deformables.reduction.eigenmodes import solve_eigenmodes as solve_eigenmodes
    from softmode.deformables.reduction.hold import carry_over as carry_over
    from softmode.deformables.reduction.hold import hold as hold
    from softmode.deformables.reduction.hold import paint as paint
    from softmode.deformables.reduction.options import BuildOptions as BuildOptions
    from softmode.deformables.reduction.patch import Patch as Patch
    from softmode.deformables.reduction.reduced_stiffness import elastic_modes as elastic_modes
    from softmode.deformables.reduction.report import BodyReport as BodyReport
    from softmode.deformables.reduction.report import report_body as report_body
    from softmode.deformables.skinning.averages import average_basis as average_basis
    from softmode.deformables.skinning.skin_splats import SkinSplats as SkinSplats
    from softmode.deformables.skinning.skinning_adjoint import AdjointSkinning as AdjointSkinning
    from softmode.deformables.solver.attachments import Attachment as Attachment
    from softmode.deformables.solver.attachments import attach as attach
    from softmode.deformables.solver.solver_reduced import SolverReduced as SolverReduced
    from softmode.deformables.solver.solver_reduced import SolverReducedOptions as SolverReducedOptions
    from softmode.deformables.tools.energies import SoftEnergies as SoftEnergies
    from softmode.deformables.tools.grips import GripOptions as GripOptions
    from softmode.deformables.tools.grips import Grips as Grips
    from softmode.deformables.tools.grips import add_grip_slots as add_grip_slots
    from softmode.deformables.tools.inverse_map import InverseMap as InverseMap
    from softmode.deformables.tools.markers import Markers as Markers
    from softmode.deformables.tools.parameters import PARAMETER_FLAGS as PARAMETER_FLAGS
    from softmode.deformables.tools.parameters import ShapeFriction as ShapeFriction
    from softmode.deformables.tools.parameters import set_parameters as set_parameters
    from softmode.deformables.tools.sensing import ContactSensor as ContactSensor
    from softmode.deformables.tools.sensing import ForceTorqueSensor as ForceTorqueSensor
    from softmode.deformables.tools.sensing import SurfacePressure as SurfacePressure
    from softmode.deformables.tools.start import set_states as set_states

__getattr__, __dir__ = lazy_names(__name__)
