"""Settings of the whole test run: where compiled kernels are kept, which tests need a GPU, a trained capture."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.build_sources import sources_hash
from tests.compile_once import compile_once
from tests.task_ids import IDS

if TYPE_CHECKING:
    import gymnasium as gym

gc.disable()  # until all tests are collected: it takes a quarter of the time, and imports leave next to no garbage

# Before the first import of warp: the cache lies in the checkout, so that a run leaves nothing outside it.
_TESTS = Path(__file__).resolve().parent
_CACHE = _TESTS.parent / ".cache"
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE / "warp"))
os.environ.setdefault("SB3_LOGDIR", str(_CACHE / "stable_baselines3"))  # it makes a folder in /tmp otherwise
_BODIES = Path(os.environ.get("SOFTMODE_CACHE", _CACHE / "softmode"))
if _BODIES.name != (_NAME := f"tests-{sources_hash()}"):  # as a process of this run has set it
    os.environ["SOFTMODE_CACHE"] = str(_BODIES / _NAME)  # a body does not outlive the sources that built it

# softmode's plug-in registers itself where softmode is installed, and not where a checkout is on the path alone.
pytest_plugins = ["pytester", "tests.processor_seconds"]
if not entry_points(group="pytest11", name="softmode"):
    pytest_plugins.append("pytest_softmode")

_FAST = {
    "deformables/test_adjoint.py": "gradient_by_a_parameter",
    "deformables/test_attachments.py": "free_fall_of_a_joined_pair",
    "deformables/test_body.py": "affine_closure gradients_of_quadratic_handles file_round_trip_is_exact",
    "deformables/test_contact.py": "potentials cube_at_rest_carries_its_weight",
    "deformables/test_coupling.py": "gradient_of_the_incremental_potential rigid_solve squeeze_equals_drive",
    "deformables/test_cubature.py": "stress_is_that_of_the_reference volume_weights_and_count",
    "deformables/test_eigenmodes.py": "box_eigenvalues gradient_energy_is_the_eigenvalue",
    "deformables/test_energies.py": "uniform_stretch",
    "deformables/test_factor.py": "solve back_substitution_with_known_unknowns",
    "deformables/test_friction.py": "stick_potential slides_above_the_cone",
    "deformables/test_grips.py": "a_pull_adds_its_force_times_dt_to_the_momentum a_hold_turns_the_short_way",
    "deformables/test_materials.py": "stress_is_the_gradient hessian_is_the_projected_derivative singular_values",
    "deformables/test_pairs.py": "gradient_of_the_potential_of_a_world",
    "deformables/test_quadrature.py": "box_is_integrated_exactly sphere_and_capsule_have_closed_form_moments",
    "deformables/test_regions.py": "identities_hold_with_regions",
    "deformables/test_rkpm.py": "partition_of_unity_and_linear_reproduction gradient_matches_finite_differences",
    "deformables/test_sensing.py": "torque_turns_the_body centre_of_pressure_of_an_eccentric_load",
    "deformables/test_shape_queries.py": "distance normal_is_gradient",
    "deformables/test_skinning.py": "matches_numpy affine_motion_is_exact",
    "deformables/test_skinning_adjoint.py": "matches_central_differences",
    "deformables/test_solver_reduced.py": "step_equals_dense_reference free_fall captured_graph_equals_eager",
    "deformables/test_static_response.py": "axial_response_is_that_of_a_hanging_bar",
    "demonstrations/test_format.py": "info data_table episodes_table"
    " statistics_of_the_dataset_equal_those_of_all_its_frames",
    "documentation/test_prose.py": "",
    "objects/test_objects.py": "part_is_chosen_by_its_rule a_tilted_box_lies_down_on_its_nearest_face",
    "objects/test_primitives.py": "solid_has_the_closed_form_volume_area_and_bounds",
    "envs/test_push_soft.py": "observation_says_where_to_go reward_is_the_sum_of_its_terms",
    "scenes/test_splat_scene.py": "kinetic_energy_of_free_fall_is_the_work_of_gravity",
    "scenes/test_table_scene.py": "configuration_is_checked",
    "learning/test_checkpoints.py": "round_trip",
    "learning/test_policy.py": "the_interval_is_wilsons",
    "learning/test_ppo.py": "adam_is_adam densities_are_those_of_a_gaussian moments_are_those_of_all_samples",
    "learning/test_rollout.py": "advantage_is_the_sum_of_discounted_errors statistics_count_whole_episodes",
    "robots/test_arm.py": "closed_form_reaches_the_pose builds_bodies_joints_and_pads",
    "robots/test_control.py": "measured_pose_is_newtons pose_steps_are_tracked",
    "splats/test_camera.py": "splats_and_meshes_land_on_the_same_pixel_and_depth",
    "splats/test_deformed.py": "covariance_is_f_sigma_ft",
    "splats/test_formats.py": "ply_round_trip sog_decodes_every_attribute",
    "splats/test_formats_quantised.py": "compressed_ply_decodes_every_attribute spz_decodes_every_attribute",
    "splats/test_pinhole.py": "",
    "splats/test_rasterizer.py": "matches_dense_reference spherical_harmonics_turn_with_the_object",
    "splats/test_rasterizer_adjoint.py": "direction_of_sight",
    "splats/test_splats.py": "",
    "test_checks.py": "",
    "test_cli.py": "list_envs_names_every_environment wrong_usage_exits_with_two",
    "test_faces.py": "",
    "test_import.py": "",
    "test_layers.py": "",
    "test_names.py": "",
    "test_words.py": "",
    "usd/test_export_bundle.py": "",
    "usd/test_import_newton.py": "units_of_everything",
    "view/test_session.py": "time_passes_as_told pick_meets_the_near_face time_that_did_not_fit_is_lost",
    "scenes/test_meshes.py": "bounds_and_volume",
    "deformables/test_driven.py": "driven_regions_follow_their_poses",
    "mpm/test_shapes.py": "momentum_goes_to_the_shapes",
    "radiance/test_grid.py": "plenoxels",
    "usd/test_import_scene.py": "material_of_ancestors_and_purposes",
    "usd/test_export.py": "places_turn_the_short_way",
    "robots/test_chain.py": "forward_is_the_compiler_s",
    "test_cli_splat.py": "convert_knows_what_is_up_in_the_file_it_reads",
    "envs/test_press_soft.py": "success_needs_the_force_in_the_middle_for_a_while",
}
"""Tests of `make test-fast`: quick ones of every room, by file; all of a file where none is named."""


def _is_fast(item: pytest.Item) -> bool:
    """Return whether `make test-fast` runs a test; slow parameters of one are left out.

    Raises:
        pytest.UsageError: If the table names a test of the item's file that is not there.
    """
    names = _FAST.get(item.path.relative_to(_TESTS).as_posix())
    if names is None or not isinstance(item, pytest.Function):
        return False
    for name in names.split():
        if not hasattr(item.module, f"test_{name}"):
            raise pytest.UsageError(f"tests/conftest.py names test_{name}, which {item.path.name} does not have")
    wanted = not names or item.function.__name__.removeprefix("test_") in names.split()
    return wanted and not any(item.get_closest_marker(mark) for mark in ("slow", "rest", "sphinx", "browser"))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the files that `make test-fast` takes no test of: it need not import them."""
    file = collection_path.relative_to(_TESTS).as_posix() if collection_path.is_relative_to(_TESTS) else ""
    return True if config.option.markexpr == "fast" and file.endswith(".py") and file not in _FAST else None


@pytest.fixture(scope="session")
def playbot() -> Path:
    """Return the bundled capture: a robot hovering over a patch of ground, with two loose hands."""
    from softmode.objects.captures import bundled

    found = bundled("playbot")
    assert found is not None
    return found


@pytest.fixture(scope="session")
def make_env(soft_env: Callable[..., gym.Env]) -> Callable[..., gym.Env]:
    """Return a function from a task and an obs_type to the one environment of them that all tests of a run share.

    Building one takes as long as hundreds of steps. A test begins with a reset by a seed or options, and puts back what
    no reset does.
    """

    def make(task: str, obs_type: str = "state") -> gym.Env:
        """Return the environment as it is registered; where it draws pictures, with the cameras of films."""
        films = {} if obs_type == "state" else {"render_mode": "rgb_array"}
        return soft_env(IDS[task], obs_type=obs_type, **films)

    return make


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of `make test-fast`, skip tests marked `gpu` where no CUDA device is found."""
    gone = [file for file in _FAST if not (_TESTS / file).is_file()]
    if gone:
        raise pytest.UsageError(f"tests/conftest.py names files that are not there: {', '.join(gone)}")
    for item in items:
        if _is_fast(item):
            item.add_marker("fast")
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if not marked:
        return
    import warp as wp

    if not wp.is_cuda_available():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def pytest_collection_finish() -> None:
    """Have processes compile a kernel once; an import of Warp that no test needs is not made for it."""
    if "warp" in sys.modules:
        compile_once()


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    """Collect garbage again, but never look at what the imports have left."""
    gc.freeze()
    gc.enable()
