"""MuJoCo's interpolated flex: a cage of trilinear or quadratic cells around the object (flexcomp dof, cellcount).

Elasticity is MuJoCo's own, in each cell's rotated frame, stepped by its `discrete` integrator, the one it accepts for
this; mass is lumped at the nodes, damping is zero. The clamped half metre is left out and the cage's first layer of
nodes is pinned: an exact clamp.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from benchmarks.baselines.common import FREE, SCENE, Row, hexahedral_interpolation, lines_of, measure, sample

DEGREES = {"trilinear": 1, "quadratic": 2}


def run(dof: str, cells: tuple[int, int, int], steps: int) -> Row:
    """Bend the beam with a cage of cells."""
    mujoco: Any = importlib.import_module("mujoco")
    warned: list[str] = []
    mujoco.set_mju_user_warning(lambda text: warned.append(text))
    model: Any = mujoco.MjModel.from_xml_string(_xml(dof, cells))
    data: Any = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rest = data.flexvert_xpos.copy()
    order = np.lexsort(np.round(rest, 6).T[::-1])
    points, _ = sample()
    matrix = hexahedral_interpolation(lines_of(cells), DEGREES[dof], points)
    assert np.abs(matrix @ rest[order] - points)[points[:, 0] > FREE[0, 0]].max() < 1e-6

    row = measure(
        "MuJoCo flex",
        f"{dof} {cells[0]} x {cells[1]} x {cells[2]}",
        int(model.nv),
        steps,
        lambda: mujoco.mj_step(model, data),
        lambda: matrix @ (data.flexvert_xpos[order] - rest[order]),
        note="its linear solver stops short of convergence" if data.warning.number.sum() else "",
    )
    return row


def _xml(dof: str, cells: tuple[int, int, int]) -> str:
    """Return the model; vertices of the flex are the nodes of the cage, so that `pin` can name them."""
    nodes = [DEGREES[dof] * c + 1 for c in cells]
    size = FREE[1] - FREE[0]
    spacing = [size[d] / (nodes[d] - 1) for d in range(3)]
    centre = FREE.mean(axis=0)
    mass = SCENE.density * size.prod()

    def text(values: Any) -> str:
        return " ".join(f"{v:.10g}" for v in values)

    return f"""
<mujoco>
  <option timestep="{SCENE.dt}" gravity="{text(SCENE.gravity)}" integrator="discrete"><flag contact="disable"/></option>
  <size memory="256M"/>
  <worldbody>
    <body name="beam">
      <flexcomp name="beam" type="grid" dim="3" count="{text(nodes)}" spacing="{text(spacing)}" pos="{text(centre)}"
        dof="{dof}" cellcount="{text(cells)}" mass="{mass}" radius="0.001">
        <elasticity young="{SCENE.youngs_modulus}" poisson="{SCENE.poissons_ratio}" damping="0"/>
        <contact selfcollide="none" contype="0" conaffinity="0"/>
        <pin gridrange="0 0 0 0 {nodes[1] - 1} {nodes[2] - 1}"/>
      </flexcomp>
    </body>
  </worldbody>
</mujoco>"""
