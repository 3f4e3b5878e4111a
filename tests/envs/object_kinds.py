"""Objects of the tests of sets: small, of other sizes and materials, and the environments of each one alone."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np

from softmode.deformables import BuildOptions, Material
from softmode.envs import LiftSoftConfig, LiftSoftEnv
from softmode.envs.tasks.rope_route.task import rope_scene
from softmode.envs.tasks.shape_soft.config import POST, POST_MATERIAL
from softmode.objects import ObjectConfig, ObjectSet
from softmode.objects.task_objects import ROPE_MATERIAL

CUBE = ObjectConfig(
    shape="box",
    extents=(0.05, 0.05, 0.05),
    surface_count=90,
    splat_count=400,
    build=BuildOptions(mode_count=2, kernel_count=120, cubature_count=64),
)
BALL = ObjectConfig(
    shape="sphere",
    extents=(0.06, 0.06, 0.06),
    surface_count=150,
    splat_count=700,
    build=BuildOptions(mode_count=4, kernel_count=150, cubature_count=96),
)
ROD = ObjectConfig(
    shape="cylinder",
    extents=(0.04, 0.04, 0.06),
    surface_count=110,
    splat_count=550,
    build=BuildOptions(mode_count=3, kernel_count=120, cubature_count=80),
)
KINDS = (CUBE, BALL, ROD)
MATERIALS = (
    Material(youngs_modulus=8.0e4, density=300.0),
    Material(youngs_modulus=4.0e4, density=120.0, friction=1.0),
    Material(youngs_modulus=3.0e5, density=500.0, poissons_ratio=0.4),
)
PLACE = {"position": (0.45, 0.0)}


def actions(world_count: int, step: int) -> np.ndarray:
    """Return actions that go down, close and rise, and differ from world to world."""
    down = np.array([0.0, 0.0, -1.0 if step < 14 else 0.6, 0.0, 1.0 if step < 12 else -1.0], np.float32)
    return down + np.random.default_rng(step).uniform(-0.3, 0.3, (world_count, 5)).astype(np.float32)


def posts(**options: Any) -> ObjectSet:
    """Return posts of two widths and heights, the second with more samples and functions."""
    other = replace(POST, extents=(0.026, 0.026, 0.13), surface_count=270, build=BuildOptions(mode_count=3))
    given = (replace(POST_MATERIAL, youngs_modulus=1.0e5), replace(POST_MATERIAL, density=400.0))
    return ObjectSet((POST, other), materials=given, **options)


def ropes(**options: Any) -> ObjectSet:
    """Return ropes of two lengths, radii and stiffnesses; the second has more samples and functions."""
    first = rope_scene().object
    build = replace(first.build, function_count=52, cubature_count=160)
    second = replace(first, extents=(0.38, 0.018, 0.018), surface_count=180, build=build)
    given = (ROPE_MATERIAL, replace(ROPE_MATERIAL, youngs_modulus=2.0e5, density=600.0))
    return ObjectSet((first, second), materials=given, **options)


def alone(config: Any, k: int) -> Any:
    """Return the configuration of the single environment with object k."""
    scene = replace(config.scene, object=KINDS[k], material=MATERIALS[k])
    return replace(config, objects=None, objects_one_hot=False, scene=scene)


def alone_in(config: Any, k: int) -> Any:
    """Return the configuration of the single environment with object k, of its material."""
    given = config.objects
    scene = replace(config.scene, object=given.objects[k], material=given.materials[k])
    return replace(config, objects=None, scene=scene)


def lift(objects: ObjectSet, **changes: Any) -> LiftSoftConfig:
    """Return LiftSoft with a set, every object of its own material, seen in small pictures."""
    return LiftSoftConfig(**{"objects": objects, "youngs_modulus_range": None, "image_size": 48, **changes})


@functools.cache
def lift_alone(k: int) -> LiftSoftEnv:
    """Return LiftSoft with object k alone, with pictures and labels, the one of all tests of sets."""
    config = lift(ObjectSet(KINDS), image_outputs=("segmentation",))
    return LiftSoftEnv(config=alone(config, k), obs_type="pixels", device="cpu")
