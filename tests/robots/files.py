"""Small robot files that the tests write."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import trimesh

# A two-link arm whose drives are written in three ways: a position servo through a class, a general affine actuator,
# and a gripper whose tied fingers hang on a tendon with a scaled control, as the Panda's do.
MJCF = """<mujoco model="small">
  <compiler angle="radian" meshdir="meshes"/>
  <default>
    <default class="arm">
      <joint type="hinge" axis="0 1 0" armature="0.05" damping="0.4" range="-2 2"/>
      <position kp="300" kv="12" ctrlrange="-1.5 1.5" forcerange="-40 40"/>
    </default>
    <default class="visual"><geom contype="0" conaffinity="0" group="2" density="0"/></default>
  </default>
  <asset><mesh name="wedge" file="wedge.stl"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="base" pos="0 0 0.1">
      <geom type="cylinder" size="0.05 0.1" mass="1"/>
      <body name="upper" pos="0 0 0.1">
        <joint name="shoulder" class="arm"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.8"/>
        <body name="fore" pos="0.3 0 0" euler="0 0 0.3">
          <joint name="elbow" class="arm" pos="0.01 0 0" frictionloss="0.1"/>
          <geom type="box" size="0.1 0.02 0.02" pos="0.1 0 0" mass="0.4"/>
          <geom class="visual" type="sphere" size="0.03"/>
          <site name="pinch" pos="0.25 0 0" euler="0 0.2 0"/>
          <body name="jaw_left" pos="0.2 0 0">
            <joint name="left" type="slide" axis="0 1 0" range="0 0.04" armature="0.1" damping="3"/>
            <geom type="mesh" mesh="wedge" mass="0.05"/>
          </body>
          <body name="jaw_right" pos="0.2 0 0">
            <joint name="right" type="slide" axis="0 -1 0" range="0 0.04" armature="0.1" damping="3"/>
            <geom type="box" size="0.03 0.005 0.01" pos="0.03 -0.01 0" mass="0.05"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon>
  <equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0"/></equality>
  <actuator>
    <position class="arm" joint="shoulder"/>
    <general joint="elbow" biastype="affine" gainprm="200" biasprm="0 -200 -8" ctrlrange="-2 2"/>
    <general tendon="split" biastype="affine" gainprm="0.5" biasprm="0 -800 -60" ctrlrange="0 64" forcerange="-24 24"/>
  </actuator>
  <keyframe><key name="rest" qpos="0 0 0 0"/><key name="home" qpos="-0.4 0.9 0.02 0.02"/></keyframe>
</mujoco>
"""

URDF = """<robot name="lifter">
  <link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="arm">
    <inertial><origin xyz="0.15 0 0"/><mass value="1.2"/>
      <inertia ixx="0.001" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://lifter/meshes/arm.dae"/></geometry></visual>
    <collision><origin xyz="0.15 0 0" rpy="0 1.5707963 0"/>
      <geometry><cylinder radius="0.02" length="0.3"/></geometry></collision>
  </link>
  <link name="jaw_a">
    <inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="package://lifter/meshes/wedge.stl"/></geometry></collision>
  </link>
  <link name="jaw_b">
    <inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.04 0.01 0.02"/></geometry></collision>
  </link>
  <link name="tool0"/>
  <joint name="lift" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
    <limit lower="-1.2" upper="0.3" effort="60" velocity="2"/><dynamics damping="0.5" friction="0.1"/></joint>
  <joint name="tool_mount" type="fixed"><parent link="arm"/><child link="tool0"/><origin xyz="0.32 0 0"/></joint>
  <joint name="jaw_a" type="prismatic"><parent link="tool0"/><child link="jaw_a"/><origin xyz="0 0.01 0"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.03" effort="20" velocity="1"/></joint>
  <joint name="jaw_b" type="prismatic"><parent link="tool0"/><child link="jaw_b"/><origin xyz="0 -0.01 0"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.03" effort="20" velocity="1"/>
    <mimic joint="jaw_a" multiplier="1" offset="0"/></joint>
</robot>
"""


def write_mjcf(folder: Path, text: str = MJCF) -> Path:
    """Write an MJCF robot with the mesh it names; return its path."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    write_wedge(folder / "meshes" / "wedge.stl")
    path = folder / "small.xml"
    path.write_text(text)
    return path


def write_urdf(folder: Path, text: str = URDF) -> Path:
    """Write a URDF in the customary layout, urdf/ beside meshes/; return its path."""
    for name in ("meshes", "urdf"):
        (folder / "lifter" / name).mkdir(parents=True, exist_ok=True)
    write_wedge(folder / "lifter" / "meshes" / "wedge.stl")
    path = folder / "lifter" / "urdf" / "lifter.urdf"
    path.write_text(text)
    return path


def write_wedge(path: Path) -> None:
    """Write an L-shaped finger without its end face: neither convex nor closed."""
    parts = [trimesh.creation.box((0.06, 0.01, 0.02)), trimesh.creation.box((0.01, 0.02, 0.02))]
    parts[1].apply_translation((0.025, 0.005, 0.0))
    mesh: Any = trimesh.util.concatenate(parts)
    mesh.update_faces([k > 1 for k in range(len(mesh.faces))])
    mesh.export(path)


_JAWS = """
      <body name="jaw_a" pos="0 0 0.012">
        <joint name="jaw_a" type="slide" axis="0 1 0" range="0 0.045" armature="0.1"/>
        <geom type="box" size="0.012 0.006 0.035" pos="0 0.006 0.035" mass="0.05"/>{knuckle}
      </body>
      <body name="jaw_b" pos="0 0 0.012">
        <joint name="jaw_b" type="slide" axis="0 -1 0" range="0 0.045" armature="0.1"/>
        <geom type="box" size="0.012 0.006 0.035" pos="0 -0.006 0.035" mass="0.05"/>
      </body>"""

_ARM5 = """<mujoco model="arm5">
  <compiler angle="radian"/>
  <default>
    <joint damping="2" armature="0.3"/>
    <position kp="4000" kv="200" forcerange="-90 90"/>
  </default>
  <worldbody>
    <body name="base">
      <geom type="cylinder" size="0.06 0.05" pos="0 0 0.05" mass="2"/>
      <body name="turn" pos="0 0 0.1">
        <joint name="turn" axis="0 0 1" range="-3 3"/>
        <geom type="cylinder" size="0.05 0.05" pos="0 0 0.05" mass="1.5"/>
        <body name="upper" pos="0 0 0.15">
          <joint name="shoulder" axis="0 1 0" range="-2 2"/>
          <geom type="capsule" fromto="0 0 0 0 0 0.35" size="0.035" mass="1.5"/>
          <body name="fore" pos="0 0 0.35">
            <joint name="elbow" axis="0 1 0" range="-2.7 2.7"/>
            <geom type="capsule" fromto="0 0 0 0 0 0.35" size="0.03" mass="1.2"/>
            <body name="wrist" pos="0 0 0.35">
              <joint name="wrist" axis="0 1 0" range="-2.4 2.4"/>
              <geom type="capsule" fromto="0 0 0 0 0 0.06" size="0.025" mass="0.6"/>
              <body name="roll" pos="0 0 0.09">
                <joint name="roll" axis="0 0 1" range="-2.9 2.9"/>
                <geom type="box" size="0.03 0.06 0.012" mass="0.4"/>{jaws}
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>{tendon}
  <actuator>
    <position joint="turn"/><position joint="shoulder"/><position joint="elbow"/><position joint="wrist"/>
    <position joint="roll"/>{servo}
  </actuator>
  <keyframe><key name="home" qpos="0 0.2 1.6 1.34 0{opening}"/></keyframe>
</mujoco>
"""
_TENDON = """
  <tendon><fixed name="both"><joint joint="jaw_a" coef="0.5"/><joint joint="jaw_b" coef="0.5"/></fixed></tendon>"""
_SERVO = """
    <position tendon="both" kp="100" kv="10" ctrlrange="0 0.045" forcerange="-80 80"/>"""
ARM5 = _ARM5.format(jaws=_JAWS.format(knuckle=""), tendon=_TENDON, servo=_SERVO, opening=" 0.045 0.045")
"""An arm of five joints whose gripper hangs on one soft servo; no link has a usual name, no equality ties the jaws."""


_ONE_JAW = """
                <geom type="box" size="0.01 0.004 0.04" pos="0 -0.004 0.06" mass="0.05"/>
                <body name="jaw" pos="0 0 0.02">
                  <joint name="jaw" axis="-1 0 0" range="0 1" armature="0.001" damping="0.01"/>
                  {shape}
                </body>"""
_BOX = '<geom type="box" size="0.01 0.004 0.04" pos="0 0.004 0.04" mass="0.05"/>'


def one_jaw(shape: str = _BOX) -> str:
    """Return the arm of five joints with a jaw 80 mm long that turns against a fixed one, both of boxes."""
    servo = """<position joint="jaw" kp="10" kv="0.5" forcerange="-5 5"/>"""
    return _ARM5.format(jaws=_ONE_JAW.format(shape=shape), tendon="", servo=servo, opening=" 0.5")


def write_arm5(folder: Path, text: str = ARM5) -> Path:
    """Write the arm of five joints; return its path."""
    path = folder / "arm5.xml"
    path.write_text(text)
    return path


_KNUCKLE = """
        <body name="knuckle_a"><geom type="box" size="0.012 0.005 0.005" pos="0 -0.006 0.005" mass="0.01"/></body>"""
GRIPPER = f"""<mujoco model="gripper">
  <compiler angle="radian"/>
  <default><position kp="4000" kv="200"/></default>
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.03 0.06 0.006" pos="0 0 0.006" mass="0.2"/>
      <site name="pinch" pos="0 0 0.06"/>{_JAWS.format(knuckle=_KNUCKLE)}
    </body>
  </worldbody>
  <actuator><position joint="jaw_a" ctrlrange="0 0.045"/><position joint="jaw_b" ctrlrange="0 0.045"/></actuator>
</mujoco>
"""
"""A gripper alone; beside one finger's root a knuckle stands out towards the other."""


def write_arm_and_gripper(folder: Path) -> tuple[Path, Path]:
    """Write the arm of five joints without its jaws, and the gripper; return both paths."""
    arm = write_arm5(folder, _ARM5.format(jaws="", tendon="", servo="", opening=""))
    gripper = folder / "gripper.xml"
    gripper.write_text(GRIPPER)
    return arm, gripper


_FINGER = """
      <body name="{name}_base" pos="{place}" euler="0 0 {yaw}">
        <joint name="{name}_0" axis="0 0 1" range="-0.9 0.9"/>
        <geom type="sphere" size="0.009" mass="0.02"/>
        <body name="{name}_proximal">
          <joint name="{name}_1" axis="0 1 0" range="-0.6 1.6"/>
          <geom type="capsule" fromto="0.01 0 0 0.045 0 0" size="0.009" mass="0.03"/>
          <body name="{name}_medial" pos="0.055 0 0">
            <joint name="{name}_2" axis="0 1 0" range="-0.2 1.7"/>
            <geom type="capsule" fromto="0.005 0 0 0.03 0 0" size="0.009" mass="0.02"/>
            <body name="{name}_distal" pos="0.04 0 0">
              <joint name="{name}_3" axis="0 1 0" range="-0.2 1.7"/>
              <geom type="capsule" fromto="0.005 0 0 0.02 0 0" size="0.009" mass="0.01"/>
              <body name="{name}_tip" pos="0.03 0 0">
                <geom type="sphere" size="0.012" mass="0.01"/>
              </body>
            </body>
          </body>
        </body>
      </body>"""
_FINGERS = {"ff": -0.9, "mf": 0.0, "rf": 0.9, "th": math.pi}
"""At which angle about the palm each finger stands out [rad]."""


def hand_mjcf() -> str:
    """Return a hand of 16 joints that looks down: a palm and four fingers, of capsules, that close downwards."""
    places = {name: f"{0.045 * math.cos(yaw)} {0.045 * math.sin(yaw)} 0" for name, yaw in _FINGERS.items()}
    fingers = "".join(_FINGER.format(name=name, place=places[name], yaw=yaw) for name, yaw in _FINGERS.items())
    drives = "".join(f'<position joint="{name}_{k}" kp="2" kv="0.05"/>' for name in _FINGERS for k in range(4))
    return f"""<mujoco model="hand">
  <compiler angle="radian"/>
  <default><joint damping="0.02" armature="0.001"/></default>
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.03 0.035 0.012" pos="0 0 0.012" mass="0.4"/>{fingers}
    </body>
  </worldbody>
  <actuator>{drives}</actuator>
</mujoco>
"""


def write_hand(folder: Path) -> Path:
    """Write the hand of 16 joints; return its path."""
    path = folder / "hand.xml"
    path.write_text(hand_mjcf())
    return path
