"""Names that softmode reads and writes in OpenUSD stages: schemas, attributes, prim types.

The module imports nothing: it also serves the process of its own that opens untrusted stages.

Reference:
    AOUSD proposal "Deformable Physics" (OpenUSD-proposals, pull request 111); newton-usd-schemas 0.6; Omni Physics 107
    and the `PhysxDeformable*` schemas that it replaced; NVIDIA Kaolin's `KaolinSkinnedPhysicsAPI`.
"""

from __future__ import annotations

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
"""Suffixes of stages that can be read."""

# Schemas of the AOUSD proposal and of Newton.
BODY_API = "PhysicsDeformableBodyAPI"
VOLUME_SIM_API = "PhysicsVolumeDeformableSimAPI"
SURFACE_SIM_API = "PhysicsSurfaceDeformableSimAPI"
POINTS_SIM_API = "NewtonPointsDeformableSimAPI"
MPM_SCENE_API = "NewtonMPMSceneAPI"
"""On a PhysicsScene whose points are grains, fluids and the like, stepped by Newton's material point method."""
VOLUME_MATERIAL_API = "PhysicsVolumeDeformableMaterialAPI"
"""Young's modulus, Poisson's ratio and density of a soft solid."""

# Attributes of the proposal, in the stage's units: mass / (length * time^2), none, mass, mass.
YOUNGS_MODULUS = "physics:youngsModulus"
POISSONS_RATIO = "physics:poissonsRatio"
MASS = "physics:mass"
MASSES = "physics:masses"
MATERIAL_PURPOSE = "physics"
"""Purpose of the binding to a physics material: the relationship `material:binding:physics`."""

# Older and vendor names, in the order in which they are tried after those of the proposal.
BODY_APIS = (BODY_API, "OmniPhysicsDeformableBodyAPI", "PhysxAutoDeformableBodyAPI", "PhysxDeformableBodyAPI")
SIM_APIS = (
    VOLUME_SIM_API,
    SURFACE_SIM_API,
    POINTS_SIM_API,
    "OmniPhysicsVolumeDeformableSimAPI",
    "OmniPhysicsSurfaceDeformableSimAPI",
)
CURVES_SIM_APIS = ("PhysicsCurvesDeformableSimAPI", "OmniPhysicsCurvesDeformableSimAPI")
"""Cables, which Newton has bodies of its own for."""
SURFACE_SIM_APIS = (SURFACE_SIM_API, "OmniPhysicsSurfaceDeformableSimAPI")
NAMESPACES = ("physics", "omniphysics", "physxDeformableBody", "physxDeformableBodyMaterial")
"""Namespaces of the attributes above, such as `omniphysics:youngsModulus`."""
COOKING_SOURCE = "physxDeformableBody:cookingSourceMesh"
"""Relationship of an automatic Omni body to the mesh that it is made from."""

# Prim types that may be a body's geometry.
TET_MESH = "TetMesh"
MESH = "Mesh"
POINTS = "Points"
SPLATS = "ParticleField3DGaussianSplat"

# What softmode writes beside the standard names; plain attributes, no plug-in is needed to open the stage.
PREFIX = "softmode:"
FORMAT = "softmode:format"
"""String on the prim of a body: `BUNDLE_FORMAT`; absent on bodies of other tools."""
BUNDLE_FORMAT = "softmode.usd 1"
BODY_PREFIX = "softmode:body:"
"""One attribute for each array of the ReducedBody: `softmode:body:<field>`, flat in C order, in its dtype."""
BODY_HEADER = "softmode:body:header"
"""String: JSON of the fields that are no arrays, and of dtype and shape of those that are."""
BODY_SHA256 = "softmode:body:sha256"
"""String: `content_digest` of header and arrays, checked on reading."""
MATERIAL_PREFIX = "softmode:material:"
"""One attribute (double, or token for the model) on the body's prim for each field of Material, in SI units. Its value
counts as long as it agrees with the standard attribute to float32: whoever edits the standard one is heard."""
SPLAT_BODY = "softmode:splats:body"
"""Relationship from a splat prim to the prim of the body whose picture it is, where it does not lie beneath it."""
WEIGHTS = "primvars:softmode:weights"
"""Skinning weights W_j of splats, the constant one last: float[] or half[], elementSize = number of handles,
interpolation vertex."""
HANDLES = "softmode:handles"
"""Time samples of the handles' transforms, on the body's prim: matrix4d[], see `usd.handles`."""
HANDLES_QUADRATIC = "softmode:handles:quadratic"
"""Time samples of what quadratic handles have beside: double3[], six rows for each."""
DENTS = "softmode:dents"
"""Time samples of the dents that contact leaves, on the body's prim: float3[] in its frame, see `deformables.contact`.
Absent where nothing was touched."""
DENT_SAMPLES = "softmode:dents:samples"
"""The surface samples that have them: int[], as many."""

# Kaolin's exchange format, a schema applied several times: `kaolin_skinned_physics:<instance>:<name>`.
KAOLIN_SKINNED_API = "KaolinSkinnedPhysicsAPI"
KAOLIN_MATERIAL_API = "KaolinPhysicsMaterialAPI"
KAOLIN_PREFIX = "kaolin_skinned_physics:"
