"""Distances and normals of rigid shapes against float64 twins; which shapes are refused; status names."""

import dataclasses

import newton
import numpy as np
import pytest
import trimesh
import warp as wp

from softmode.deformables.contact import shape_tables
from softmode.deformables.contact.shape_query_kernels import Heightfields
from softmode.deformables.contact.shape_tables import heightfields, is_closed
from softmode.deformables.model import status as bits
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.errors import ConfigError
from tests import reference
from tests.bodies import cube
from tests.deformables.probe_kernels import query_points

FLOAT32 = float(np.finfo(np.float32).eps)
KIND = newton.GeoType
ShapeConfig = newton.ModelBuilder.ShapeConfig


def query(kind, scale, points, *, mesh=0, fields=None, reach=10.0):
    """Return distances (N,) and normals (N, 3) of points in the frame of a shape."""
    fields = fields or Heightfields()
    with wp.ScopedDevice("cpu"):
        x = wp.array(points, dtype=wp.vec3)
        distance, normal = wp.zeros(len(points), dtype=float), wp.zeros(len(points), dtype=wp.vec3)
        inputs = [int(kind), wp.vec3(*scale), wp.uint64(mesh), fields, x, reach]
        wp.launch(query_points, dim=len(points), inputs=inputs, outputs=[distance, normal])
    return distance.numpy(), normal.numpy()


def as_newton(mesh):
    """Return a trimesh as Newton's mesh."""
    return newton.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces).ravel())


def distance_bounded_plane(x):
    """Return the distance to all that lies below a rectangle of 0.6 by 0.4."""
    far = 1.0e3
    return reference.distance_box(x + np.array([0.0, 0.0, far]), np.array([0.3, 0.2, far]))


AXES = np.array([0.5, 0.3, 0.1])
SHAPES = {
    "plane": (KIND.PLANE, (0.0, 0.0, 0.0), reference.distance_plane),
    "bounded plane": (KIND.PLANE, (0.6, 0.4, 0.0), distance_bounded_plane),
    "sphere": (KIND.SPHERE, (0.3, 0.0, 0.0), lambda x: reference.distance_sphere(x, 0.3)),
    "capsule": (KIND.CAPSULE, (0.2, 0.3, 0.0), lambda x: reference.distance_capsule(x, 0.2, 0.3)),
    "cylinder": (KIND.CYLINDER, (0.2, 0.3, 0.0), lambda x: reference.distance_cylinder(x, 0.2, 0.3)),
    "cone": (KIND.CONE, (0.3, 0.4, 0.0), lambda x: reference.distance_cone(x, 0.3, 0.4)),
    "flat cone": (KIND.CONE, (0.5, 0.02, 0.0), lambda x: reference.distance_cone(x, 0.5, 0.02)),
    "ellipsoid": (KIND.ELLIPSOID, AXES, lambda x: reference.distance_ellipsoid(x, AXES)),
    "lens": (KIND.ELLIPSOID, (0.5, 0.5, 0.01), lambda x: reference.distance_ellipsoid(x, np.array([0.5, 0.5, 0.01]))),
    "ball": (KIND.ELLIPSOID, (0.3, 0.3, 0.3), lambda x: reference.distance_sphere(x, 0.3)),
    "box": (KIND.BOX, (0.2, 0.3, 0.1), lambda x: reference.distance_box(x, np.array([0.2, 0.3, 0.1]))),
}


def points_about(seed=0, count=2000, flat=1.0):
    """Return points around the origin, some of them squeezed towards z = 0."""
    x = np.random.default_rng(seed).uniform(-0.6, 0.6, size=(count, 3)).astype(np.float32)
    x[::2, 2] *= flat
    return x


# -- primitives --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHAPES)
def test_distance(name):
    """The signed distance equals the twin's, inside and outside; a step back along the normal ends on the surface."""
    kind, scale, distance = SHAPES[name]
    x = points_about(flat=0.01 if name in ("lens", "flat cone") else 1.0)
    d, n = query(kind, scale, x)
    expected = distance(x.astype(float))
    depth = 0.003 if name in ("lens", "flat cone") else 0.01
    assert (expected < -depth).any() and (expected > depth).any()
    np.testing.assert_allclose(d, expected, atol=8 * FLOAT32)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=8 * FLOAT32)
    np.testing.assert_allclose(distance(x - d[:, None] * n.astype(float)), 0.0, atol=16 * FLOAT32)


@pytest.mark.parametrize("name", SHAPES)
def test_normal_is_gradient(name):
    """The normal is the gradient by central differences of the twin, where they agree with those of twice the step."""
    kind, scale, distance = SHAPES[name]
    x = points_about(seed=1, count=500)
    step = 1.0e-5

    def gradient(h):
        y = x.astype(float)
        return np.stack([(distance(y + h * e) - distance(y - h * e)) / (2.0 * h) for e in np.eye(3)], axis=-1)

    fine, coarse = gradient(step), gradient(2.0 * step)
    smooth = np.linalg.norm(fine - coarse, axis=1) < 1e-6  # not across a ridge of the distance
    smooth &= np.abs(distance(x.astype(float))) > 1e-3  # nearer to a rim, the direction is lost to rounding
    assert smooth.mean() > 0.9
    np.testing.assert_allclose(query(kind, scale, x)[1][smooth], fine[smooth], atol=1e-4)


@pytest.mark.parametrize("name", SHAPES)
def test_distance_at_symmetric_points(name):
    """Centres, axes, faces, edges and tips, where the gradient is not unique: the distance, and a unit normal to it."""
    kind, scale, distance = SHAPES[name]
    s = np.asarray(scale)
    ends = [t * e for e in np.diag([s[0], s[1], s[1] if s[2] == 0.0 else s[2]]) for t in (-1.0, -0.5, 0.5, 1.0, 2.0)]
    x = np.array([[0, 0, 0], [0.0, 0.3, 0.1], [0.0, 0.0, 0.05], *ends], np.float32)
    x = np.concatenate([x, x * [1.0, 1.0, -1.0]]).astype(np.float32)
    d, n = query(kind, scale, x)
    # on its planes of symmetry the twin of the ellipsoid bisects to sqrt(1e-14) only
    np.testing.assert_allclose(d, distance(x.astype(float) + 1e-9), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=8 * FLOAT32)
    np.testing.assert_allclose(distance(x - d[:, None] * n.astype(float) + 1e-9), 0.0, atol=1e-6)


# -- meshes ------------------------------------------------------------------------------------------------------------


def box_of(*extents):
    """Return a box as a triangle mesh, and its distance."""
    half = 0.5 * np.array(extents)
    return trimesh.creation.box(extents), lambda x: reference.distance_box(x, half)


def soup_of(mesh):
    """Return a triangle mesh, and its distance by the twin."""
    return mesh, lambda x: reference.distance_mesh(x, np.asarray(mesh.triangles, np.float32).astype(float))


def wedge():
    """Return a blade: 8 mm at the back, an edge of 1.5 degrees at the front."""
    back = [[0.3, y, z] for y in (-0.2, 0.2) for z in (-0.004, 0.004)]
    return trimesh.convex.convex_hull(np.array([[0.0, -0.2, 0.0], [0.0, 0.2, 0.0], *back]))


MESHES = {
    "box": lambda: box_of(0.4, 0.6, 0.2),
    "plate of 2 mm": lambda: box_of(0.3, 0.3, 0.002),
    "plate of 0.2 mm": lambda: box_of(0.3, 0.3, 0.0002),
    "blade": lambda: soup_of(wedge()),
    "needle": lambda: soup_of(trimesh.creation.cone(0.002, 0.3, sections=8)),
    "torus": lambda: soup_of(trimesh.creation.torus(0.2, 0.05, major_sections=16, minor_sections=8)),
}


@pytest.mark.parametrize("name", MESHES)
def test_mesh_distance(name):
    """Distance and normal of a triangle mesh near its faces, edges and corners, however thin or sharp it is."""
    mesh, distance = MESHES[name]()
    rng = np.random.default_rng(1)
    face = rng.integers(0, len(mesh.faces), 400)
    on = np.einsum("nk,nkd->nd", rng.dirichlet((0.3, 0.3, 0.3), 400), mesh.triangles[face])
    x = (on + rng.normal(size=(400, 3)) * 10.0 ** rng.uniform(-4.0, -1.5, (400, 1))).astype(np.float32)
    source = as_newton(mesh)
    d, n = query(KIND.MESH, (1.0, 1.0, 1.0), x, mesh=source.finalize(device="cpu"))
    expected = distance(x.astype(float))
    assert (expected < 0.0).any() and (expected > 0.01).any()
    # Warp leaves out triangles thinner than 1e-3 of their length: of the thinnest plate, its rim
    sliver = 0.5e-4 * np.sqrt(2.0) if name == "plate of 0.2 mm" else 0.0
    np.testing.assert_allclose(d, expected, atol=16 * FLOAT32 + sliver)
    clear = np.abs(expected) > 1e-5 + sliver  # nearer, the direction is lost to rounding
    back = distance(x - d[:, None] * n.astype(float))
    np.testing.assert_allclose(back[clear], 0.0, atol=32 * FLOAT32 + sliver)
    assert (np.sign(d) == np.sign(expected))[clear].all()


def test_scaled_mesh():
    """A mesh scaled by 2 has the distances of the larger box."""
    mesh, distance = box_of(0.4, 0.6, 0.2)
    half = as_newton(trimesh.Trimesh(0.5 * mesh.vertices, mesh.faces))
    x = points_about()
    d, _ = query(KIND.MESH, (2.0, 2.0, 2.0), x, mesh=half.finalize(device="cpu"))
    np.testing.assert_allclose(d, distance(x.astype(float)), atol=16 * FLOAT32)


def test_sign_of_symmetric_points():
    """No point of a regular grid, on edges and diagonals of a finely meshed box, is taken for the other side."""
    mesh = as_newton(trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().subdivide())
    g = np.linspace(-0.12, 0.12, 31)
    x = np.stack(np.meshgrid(g, g, g), axis=-1).reshape(-1, 3).astype(np.float32)
    d, _ = query(KIND.MESH, (1.0, 1.0, 1.0), x, mesh=mesh.finalize(device="cpu"))
    np.testing.assert_allclose(d, reference.distance_box(x.astype(float), np.full(3, 0.1)), atol=8 * FLOAT32)


# -- heightfields ------------------------------------------------------------------------------------------------------


def field_triangles(heights, half, floor):
    """Return the closed triangles of a heightfield over a floor: cells split from (0, 0) to (1, 1), walls, bottom."""
    rows, columns = heights.shape
    X, Y = np.meshgrid(np.linspace(-half[0], half[0], columns), np.linspace(-half[1], half[1], rows))
    P = np.stack([X, Y, heights], axis=-1)
    a, b, c, d = P[:-1, :-1], P[:-1, 1:], P[1:, 1:], P[1:, :-1]
    top = [np.stack(corners, axis=2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))]
    rim = np.concatenate([P[0, :-1], P[:-1, -1], P[-1, :0:-1], P[:0:-1, 0]])
    low = rim * [1.0, 1.0, 0.0] + [0.0, 0.0, floor]
    after, low_after = np.roll(rim, -1, axis=0), np.roll(low, -1, axis=0)
    walls = [np.stack(corners, axis=1) for corners in ((low, low_after, after), (low, after, rim))]
    return np.concatenate([*top, *walls, np.stack([low_after, low, np.full_like(low, [[0.0, 0.0, floor]])], axis=1)])


@pytest.fixture(scope="module")
def terrain():
    """Return a rough heightfield of 8 by 12 cells: its tables and its distance over a floor far below."""
    rng = np.random.default_rng(0)
    builder = newton.ModelBuilder()
    field = newton.Heightfield(rng.uniform(-0.1, 0.2, (9, 13)), 9, 13, hx=0.6, hy=0.4)
    builder.add_shape_heightfield(heightfield=newton.Heightfield(rng.uniform(size=(3, 4)), 3, 4))
    builder.add_shape_heightfield(heightfield=field)
    model = builder.finalize(device="cpu")
    fields = heightfields(model)
    fields.index = wp.array([1], dtype=int, device="cpu")  # the probe asks for shape 0
    heights = (field.min_z + field.data * (field.max_z - field.min_z)).astype(float)
    triangles = field_triangles(heights, (field.hx, field.hy), -20.0)
    return fields, lambda x: reference.distance_mesh(x, triangles)


@pytest.mark.filterwarnings("ignore:Heightfield-vs-heightfield")
def test_heightfield_distance(terrain):
    """The distance to the triangulated surface and to the walls; below, however deep, to the way out."""
    fields, distance = terrain
    x = np.random.default_rng(2).uniform(-0.9, 0.9, (400, 3)).astype(np.float32) * [1.0, 1.0, 0.5]
    d, n = query(KIND.HFIELD, (1.0, 1.0, 1.0), x, fields=fields)
    expected = distance(x)
    assert (expected < -0.2).any() and (expected > 0.2).any()
    np.testing.assert_allclose(d, expected, atol=8 * FLOAT32)
    clear = np.abs(expected) > 1e-4
    np.testing.assert_allclose(distance(x - d[:, None] * n.astype(float))[clear], 0.0, atol=16 * FLOAT32)
    for reach in (0.05, 0.2):
        near = query(KIND.HFIELD, (1.0, 1.0, 1.0), x, fields=fields, reach=reach)[0]
        np.testing.assert_allclose(near[expected < reach], expected[expected < reach], atol=8 * FLOAT32)
        assert (near[expected > reach + 1e-6] > reach).all()


def test_heightfield_normal_on_the_surface(terrain):
    """At grid points and on edges the normal is that of a triangle there, and nothing is nan."""
    fields, distance = terrain
    grid, extent = fields.grid.numpy()[1], fields.extent.numpy()[1]
    row, column = np.meshgrid(np.arange(grid[1]), np.arange(grid[2]), indexing="ij")
    z = extent[2] + (extent[3] - extent[2]) * fields.elevation.numpy()[grid[0] :][: row.size]
    u, v = 2.0 * column / (grid[2] - 1) - 1.0, 2.0 * row / (grid[1] - 1) - 1.0
    x = np.stack([extent[0] * u.ravel(), extent[1] * v.ravel(), z], axis=1).astype(np.float32)
    d, n = query(KIND.HFIELD, (1.0, 1.0, 1.0), x, fields=fields)
    np.testing.assert_allclose(d, 0.0, atol=8 * FLOAT32)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=8 * FLOAT32)
    assert (distance(x + 1e-3 * n.astype(float)) > 0.0).mean() > 0.5  # the rest are valleys


# -- what is refused ---------------------------------------------------------------------------------------------------


def solver_with(add_shape, world_count=1):
    """Build a solver for a cube and one shape."""
    body, world = cube(), newton.ModelBuilder()
    add_shape(world)
    add_reduced_body(world, body, position=(0.0, 0.0, 1.0))
    builder = newton.ModelBuilder()
    builder.replicate(world, world_count)
    return SolverReduced(builder.finalize(device="cpu"), [body])


def opened():
    """Return a box without its last triangle."""
    box = trimesh.creation.box((0.4, 0.4, 0.4))
    return newton.Mesh(np.asarray(box.vertices), np.asarray(box.faces[:-1]).ravel())


def rough(config, friction):
    """Return a shape configuration with a friction."""
    return dataclasses.replace(config or newton.ModelBuilder.ShapeConfig(), mu=friction)


REFUSED = {
    "negative friction": (
        lambda w, cfg=None, **kw: w.add_shape_sphere(-1, radius=0.1, cfg=rough(cfg, -0.1), **kw),
        "friction -0.1.*mu",
    ),
    "open mesh": (lambda w, **kw: w.add_shape_mesh(-1, mesh=opened(), **kw), "not closed.*hull"),
    "barrel": (
        lambda w, **kw: w.add_shape_cylinder(-1, radius=0.1, half_height=0.1, barrel_radius=0.5, **kw),
        "barrel_radius.*straight cylinder",
    ),
    "uneven mesh": (
        lambda w, **kw: w.add_shape_mesh(-1, mesh=as_newton(box_of(1, 1, 1)[0]), scale=(1, 2, 1), **kw),
        "scaled by.*vertices",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_shape(name):
    """A shape that cannot be touched is named with the remedy, unless soft bodies do not meet it."""
    add, message = REFUSED[name]
    with pytest.raises(ConfigError, match=f"(?s)odd one.*{message}"):
        solver_with(lambda w: add(w, label="odd one"))
    solver_with(lambda w: add(w, label="odd one", cfg=ShapeConfig(has_particle_collision=False)))


def test_hull_of_an_open_mesh():
    """A convex mesh stands for its hull: one of an open box holds a body that sits where the box is open."""
    solver = solver_with(lambda w: w.add_shape_convex_hull(-1, mesh=opened()))
    box = np.array([0.2, 0.2, 0.2])
    x = points_about(count=300)
    d, _ = query(KIND.CONVEX_MESH, (1.0, 1.0, 1.0), x, mesh=int(solver.tables.shapes.source.numpy()[0]))
    np.testing.assert_allclose(d, reference.distance_box(x.astype(float), box), atol=16 * FLOAT32)


def test_mesh_is_checked_once(monkeypatch):
    """64 worlds share one mesh, which is looked at once."""
    asked = []

    def spy(vertices, indices):
        asked.append(len(indices))
        return is_closed(vertices, indices)

    monkeypatch.setattr(shape_tables, "is_closed", spy)
    solver_with(lambda w: w.add_shape_mesh(-1, mesh=as_newton(box_of(1, 1, 1)[0])), world_count=64)
    assert len(asked) == 1


def test_is_closed():
    """Closed: boxes, also as loose triangles, and two that share an edge; not: a box with a hole, a sheet, nothing."""
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    loose = np.asarray(box.triangles).reshape(-1, 3)
    beside = np.concatenate([loose, loose + np.array([1.0, 1.0, 0.0])])
    assert is_closed(box.vertices, box.faces)
    assert is_closed(loose, np.arange(len(loose)))
    assert is_closed(beside, np.arange(len(beside)))
    assert not is_closed(box.vertices, box.faces[1:])
    assert not is_closed([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [0, 1, 2])
    assert not is_closed(np.zeros((0, 3)), np.zeros(0, int))


# -- status ------------------------------------------------------------------------------------------------------------


def test_status_reasons():
    """Every status bit has a name; several come lowest first; an unknown bit is refused."""
    every = [value for name, value in vars(bits).items() if name.startswith("WORLD_")]
    every += bits.PARAMETER_BITS.values()
    assert sorted(bits.REASONS) == sorted(every) and len(set(bits.REASONS.values())) == len(every)
    assert sorted(bits.REMEDIES) == sorted(bits.REASONS)
    assert bits.status_reasons(bits.WORLD_CONTACT_OVERFLOW, remedies=True) == ("contact_overflow (raise contact_max)",)
    assert bits.status_reasons(0) == ()
    assert bits.status_reasons(bits.WORLD_NOT_FINITE | bits.WORLD_CONTACT_OVERFLOW) == (
        "contact_overflow",
        "not_finite",
    )
    with pytest.raises(ConfigError, match="1024"):
        bits.status_reasons(1024)
