"""MuJoCo-Warp's own soft body in many worlds: the beam of LiftSoft as a cage of trilinear cells, held by two boxes.

Run: ``python -m benchmarks.peers_flex [--device cuda:0] [--worlds 64 1024 4096]``. The rows stand beside those of
``softmode bench --preset beam --actions grasp`` and of MuJoCo-Warp with VBD in ``benchmarks/JOURNAL.md``.

Beam, material, table and steps are those of LiftSoft's preset "beam": 0.30 x 0.04 x 0.04 m, E = 2e5 Pa, nu = 0.3, four
steps of 1/120 s per control step. The cage has one cell across and ten along, 44 nodes, 132 dofs, and the integrator is
`discrete`, which takes elasticity implicitly. Quadratic cells are refused by MuJoCo-Warp 3.17 ("Quadratic flex
interpolation (dof=quadratic) is not supported"). Instead of the arm a hand on three slides carries two fingers; it
moves at random around the beam, and the fingers close in five of six spells. There are no observations, rewards or
resets. So the peer has less to do than LiftSoft.
"""

from __future__ import annotations

import argparse
import importlib
import time
from typing import Any

import numpy as np
import warp as wp

from benchmarks.clock import in_spells, replayed
from benchmarks.peers_kernels import act_hand, count_step

CELLS = (10, 1, 1)
SIZE = (0.30, 0.04, 0.04)
YOUNGS_MODULUS, POISSONS_RATIO, DENSITY = 2.0e5, 0.3, 1000.0
DT, SUBSTEPS = 1.0 / 120.0, 4
RADIUS = 0.001
CONTACT_MAX, ROW_MAX = 128, 400
"""Contacts and rows of constraints per world that have room."""


def main() -> None:
    """Print a line per number of worlds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=None, help="default 64 1024 4096, on CPU 1")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--warmup", type=int, default=60, help="control steps before the clock starts")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    wp.set_device(options.device)
    device = wp.get_device(options.device)
    print(f"{device.name or device}: MuJoCo-Warp {importlib.import_module('mujoco_warp').__version__}")
    for count in options.worlds or ([64, 1024, 4096] if device.is_cuda else [1]):
        report(count, device, options)


def report(worlds: int, device: wp.Device, options: argparse.Namespace) -> None:
    """Make the worlds, hold the beams, time control steps."""
    mujoco: Any = importlib.import_module("mujoco")
    mujoco_warp: Any = importlib.import_module("mujoco_warp")
    clock = time.perf_counter()
    spec = mujoco.MjModel.from_xml_string(model())
    rest = mujoco.MjData(spec)
    mujoco.mj_forward(spec, rest)
    m = mujoco_warp.put_model(spec)
    d = mujoco_warp.put_data(spec, rest, nworld=worlds, nconmax=CONTACT_MAX, njmax=ROW_MAX)
    step: Any = wp.zeros(1, dtype=int)
    home: Any = wp.zeros(3, dtype=float)

    def control_step() -> None:
        wp.launch(act_hand, worlds, [step, home], [d.ctrl])
        wp.launch(count_step, 1, [step])
        for _ in range(SUBSTEPS):
            mujoco_warp.step(m, d)

    play = replayed(control_step, device)
    made = time.perf_counter() - clock
    play(options.warmup)
    contacts, rows, held = [], [], []

    def look() -> None:
        contacts.append(int(d.nacon.numpy()[0]) / worlds)
        rows.append(int(d.nefc.numpy().max()))
        held.append(float((np.abs(d.actuator_force.numpy()[:, 3:]) > 0.02).all(1).mean()))

    spent, steps = in_spells(play, options.steps, device, look)
    place = d.flexvert_xpos.numpy().reshape(worlds, -1, 3).mean(axis=1)
    finite = np.isfinite(place).all(axis=1)
    full = max(contacts) * worlds >= worlds * CONTACT_MAX or max(rows) >= ROW_MAX
    iterations = d.solver_niter.numpy().mean()
    memory = f", {wp.get_mempool_used_mem_current(device) / 1e6:,.0f} MB" if device.is_cuda else ""
    print(
        f"flex {CELLS}, {worlds} worlds, {spec.nv} dofs: {worlds * steps / spent:,.0f} env-steps/s, "
        f"{1e3 * spent / steps:.2f} ms per control step; {np.mean(contacts):.0f} contacts, at most {max(rows)} rows"
        f"{' (FULL)' if full else ''}, {iterations:.1f} iterations; both fingers press in {100 * np.mean(held):.0f} %, "
        f"finite in {finite.sum()} of {worlds}, centre {np.round(place[finite].mean(axis=0), 3)}{memory}, "
        f"made in {made:.1f} s",
        flush=True,
    )


def model() -> str:
    """Return the model; the cage's vertices are its nodes."""
    nodes = [cells + 1 for cells in CELLS]
    spacing = " ".join(f"{size / cells:.6g}" for size, cells in zip(SIZE, CELLS, strict=True))
    mass = DENSITY * float(np.prod(SIZE))
    slides = "".join(
        f'<joint name="{name}" type="slide" axis="{axis}" damping="50" armature="0.5"/>'
        for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    boxes = "".join(
        f'<body name="{name}" pos="0 {side * 0.045} 0">'
        f'<joint name="{name}" type="slide" axis="0 {side} 0" range="-0.04 0.01" damping="5" armature="0.1"/>'
        '<geom type="box" size="0.0085 0.008 0.012" density="1000" friction="1 0.005 0.0001"/></body>'
        for name, side in (("left", 1), ("right", -1))
    )
    drives = "".join(f'<position joint="{name}" kp="2000" kv="200"/>' for name in "xyz")
    drives += "".join(f'<position joint="{name}" kp="350" kv="50"/>' for name in ("left", "right"))
    return f"""
<mujoco>
  <option timestep="{DT:.10g}" integrator="discrete" cone="elliptic" iterations="50" ls_iterations="20"
    jacobian="sparse"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1" friction="1 0.005 0.0001"/>
    <body name="hand" pos="0 0 0.025" gravcomp="1">{slides}<geom type="sphere" size="0.005" mass="0.7" contype="0"
      conaffinity="0"/>{boxes}</body>
    <body name="beam" pos="0 0 {0.5 * SIZE[2] + RADIUS}">
      <flexcomp name="beam" type="grid" dim="3" count="{" ".join(map(str, nodes))}" spacing="{spacing}" pos="0 0 0"
        dof="trilinear" cellcount="{" ".join(map(str, CELLS))}" mass="{mass:.6g}" radius="{RADIUS}">
        <elasticity young="{YOUNGS_MODULUS}" poisson="{POISSONS_RATIO}" damping="0"/>
        <contact selfcollide="none" friction="1 0.005 0.0001" condim="3"/>
      </flexcomp>
    </body>
  </worldbody>
  <actuator>{drives}</actuator>
</mujoco>"""


if __name__ == "__main__":
    main()
