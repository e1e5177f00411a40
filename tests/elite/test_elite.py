"""One stored elite: found by its name in a run folder, read whole, or refused by one line that names what is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from rtcd_jax.elite.elite import Elite, NoFunnel, ellipsoid_axes, initial_and_best
from rtcd_jax.elite.records import write_elite
from rtcd_jax.system.errors import UserError
from tests.certificate import balance, swing


@pytest.fixture
def run(tmp_path):
    """A run folder whose initial candidate has a tenth of the level of its elites 000 and 001."""
    arrays, record = swing.elite()
    (tmp_path / "elites").mkdir()
    for folder, name, scale in (
        (tmp_path / "elites", "000", 1),
        (tmp_path / "elites", "001", 2),
        (tmp_path, "initial", 0.1),
    ):
        write_elite(folder, name, arrays | {"rho": scale * arrays["rho"]}, record | {"status": "OK"})
    return tmp_path


@pytest.mark.parametrize(("which", "scale"), [(0, 1), ("000", 1), (1, 2), ("initial", 0.1)])
def test_an_elite_is_found_by_number_or_name(run, which, scale):
    np.testing.assert_array_equal(Elite.read(run, which).rho, scale * swing.elite()[0]["rho"])


def test_what_is_stored_is_what_is_read(run):
    arrays, record = swing.elite()
    elite = Elite.read(run, 0)
    for name in ("time", "x", "u", "K", "S", "Q", "R", "K_goal", "x_goal", "u_max", "volumes_per_knot"):
        np.testing.assert_array_equal(getattr(elite, name), arrays[name])
    assert (elite.guarantee, elite.epsilon, elite.confidence) == ("sampled", record["epsilon"], record["confidence"])
    assert elite.state_limits.tolist() == record["state_limits"]
    assert elite.policy == {}
    policy = {"authority": 0.3}
    assert Elite.of(arrays, record | {"policy": policy}).policy == policy


def test_null_among_the_limits_is_none_at_all_and_volumes_are_known_by_name():
    arrays, record = balance.elite()
    elite = Elite.of(arrays | {"volumes_sum": np.array(3.0)}, record)
    assert elite.state_limits.tolist() == [0.3, np.inf, np.inf, np.inf]
    assert elite.volumes == {"sum": 3.0}


def test_any_push_on_a_motor_that_moves_nothing_is_borne():
    """And none is not a number."""
    arrays, record = swing.elite()
    arrays = arrays | {"pushes": np.full((len(arrays["time"]), 1), np.inf)}
    assert np.all(np.isinf(Elite.of(arrays, record).pushes))
    arrays["pushes"][0] = np.nan
    with pytest.raises(UserError, match="pushes that are not"):
        Elite.of(arrays, record)


def test_a_claimed_funnel_promises_that_no_state_fails():
    arrays, record = swing.elite()
    claimed = {key: value for key, value in record.items() if key not in ("epsilon", "confidence")}
    elite = Elite.of(arrays, claimed | {"rung": "claimed"})
    assert (elite.epsilon, elite.confidence) == (0.0, 1.0)
    with pytest.raises(UserError, match="the elite lacks epsilon, confidence"):
        Elite.of(arrays, claimed | {"rung": "sampled"})


def test_what_is_not_there_is_refused_with_what_is(run, tmp_path_factory):
    with pytest.raises(UserError, match=r"has no elite 007; there are 000, 001$"):
        Elite.read(run, 7)
    with pytest.raises(UserError, match="is no run folder"):
        Elite.read(tmp_path_factory.mktemp("empty"), 0)


@pytest.mark.parametrize(("missing", "told"), [("Q", "Q"), ("S", "S"), ("rung", "rung"), ("plant", "plant")])
def test_what_an_elite_lacks_is_told_with_its_file(run, missing, told):
    arrays, record = swing.elite()
    arrays, record = ({key: value for key, value in each.items() if key != missing} for each in (arrays, record))
    write_elite(run / "elites", "001", arrays, record | {"status": "OK"})
    with pytest.raises(UserError, match=rf"elites/001: the elite lacks {told}$"):
        Elite.read(run, "001")


def test_without_its_funnel_the_initial_candidate_is_left_out_with_the_reason(run):
    both, absence = initial_and_best(run)
    assert (list(both), absence) == (["initial", "best"], "")
    assert both["initial"].rho[0] == 0.1 * both["best"].rho[0]
    arrays, record = swing.elite()
    write_elite(run, "initial", {name: np.full_like(array, np.nan) for name, array in arrays.items()},
                record | {"status": "FUNNEL_EMPTY", "epsilon": None})  # fmt: skip
    with pytest.raises(NoFunnel, match=r"initial has no funnel \(FUNNEL_EMPTY\)"):
        Elite.read(run, "initial")
    alone, absence = initial_and_best(run)
    assert (list(alone), absence) == (["best"], "the initial candidate has no funnel (FUNNEL_EMPTY)")
    (run / "initial.json").unlink()
    assert initial_and_best(run)[1] == "no initial candidate was stored"


def test_the_axes_of_an_ellipsoid_map_the_unit_sphere_onto_its_boundary():
    elite = Elite.of(*balance.elite())
    axes = ellipsoid_axes(elite.S, elite.rho)
    y = np.random.default_rng(0).normal(size=4)
    error = axes @ (y / np.linalg.norm(y))
    np.testing.assert_allclose(np.einsum("ki,kij,kj->k", error, elite.S, error), elite.rho)
    np.testing.assert_allclose(ellipsoid_axes(elite.S[0], elite.rho[0]), axes[0])


def test_what_lies_in_every_robots_funnel_is_the_ellipsoid_about_x_less_the_farthest_center():
    """A state of it is inside the stored ellipsoid about any center that is as far from x* as the offset says."""
    elite = Elite.of(*balance.elite())
    knots, n = elite.x.shape
    offsets = np.linspace(0, 1.2, knots) * np.sqrt(elite.rho)  # the last ones are farther apart than the ellipsoids
    common = replace(elite, center_offsets=offsets).of_all_robots()
    assert elite.of_all_robots() is elite
    assert np.all(common.rho > 0)
    np.testing.assert_allclose(np.sqrt(common.rho) + offsets, np.maximum(np.sqrt(elite.rho), offsets), rtol=1e-5)
    random = np.random.default_rng(0)
    for k in np.flatnonzero(offsets < np.sqrt(elite.rho)):
        y = random.normal(size=(2, 50, n))
        inside, center = y / np.linalg.norm(y, axis=2, keepdims=True) @ ellipsoid_axes(elite.S[k], 1.0).T
        apart = np.sqrt(common.rho[k]) * inside - offsets[k] * center
        assert np.all(elite.value(k, elite.x[k] + apart) <= elite.rho[k] * (1 + 1e-9))
