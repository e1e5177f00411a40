"""Does this certificate prove this elite? Only the very file for the very numbers; who changed what is told."""

import json

import numpy as np
import pytest

from rtcd_jax.certificate import check, standing
from rtcd_jax.certificate.standing import Standing, standing_of
from rtcd_jax.elite.elite import Elite
from tests.certificate import swing
from tests.certificate.test_check import nudged, resealed


@pytest.fixture
def path(text, tmp_path):
    file = tmp_path / "000.json"
    file.write_text(text)
    return file


@pytest.fixture
def unremembered(tmp_path, monkeypatch):
    """A user whose cache is empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "empty"))


def intervals_checked(path, stored):
    """The verdict, and how many intervals the checker went through for it."""
    done = []
    return standing_of(path, Elite.of(*stored), lambda k, of: done.append(k)), len(done)


def test_a_proved_elite(run, content):
    found = standing.standing(run, "000")
    assert found.proved
    assert found.reason == ""
    assert found.claim == check.digest(content["claim"]) == content["sha256"]["claim"]
    assert f"Claim: sha256 {found.claim}." in check.sentence(check.check(content))
    assert (found.start, found.intervals) == (0.0, len(content["funnel"]))
    assert found.volumes == check.check(content).volumes


def test_a_certificate_that_is_not_there(run):
    assert standing.standing(run, "007") == Standing("missing", f"{run / 'certificates' / '007.json'} is not there")


OTHERS = {
    "a mass": (lambda a, r: r["parameters"].update(m=0.7), "parameters.m = 0.6 there, 0.7 in the elite"),
    "a limit": (lambda a, r: r["state_limits"].__setitem__(1, 8.0), "state_limits[1] = 7.0 there, 8.0 in the elite"),
    "no limit": (lambda a, r: r["state_limits"].__setitem__(1, None), "state_limits[1] is 7.0 there, none in the"),
    "a time step": (lambda a, r: a.update(time=2 * a["time"]), "dt = 0.05 there, 0.1 in the elite"),
    "a goal": (lambda a, r: a["x_goal"].__setitem__(1, 0.5), "x_goal[1] = 0.0 there, 0.5 in the elite"),
    "a goal's gain": (lambda a, r: a["K_goal"].__setitem__((0, 1), 2.0), "K_goal[1] = "),
    "an input": (lambda a, r: a["u"].__setitem__((2, 0), 0.71), "u[2] = 0.7 there, 0.71 in the elite"),
    "the last bit of a gain": (
        lambda a, r: a["K"].__setitem__((3, 0, 1), np.nextafter(a["K"][3, 0, 1], 9)), "K[3][1] = ",
    ),
    "a knot": (lambda a, r: a["x"].__setitem__((1, 0), 1.0), "x[1][0] = "),
    "a shorter motion": (lambda a, r: _shorten(a), "x has 5 entries there, 4 in the elite"),
    "a robot": (lambda a, r: r.update(plant="acrobot"), "the elite's parameters lack 'upper_mass'"),
    "a limit of its own": (lambda a, r: a.update(u_max=np.array([3.0])), "u_max = 3.0: must be torque_limit = 2.5"),
}  # fmt: skip


def _shorten(arrays):
    arrays.update({key: arrays[key][1:] for key in ("time", "x", "u", "K", "S", "rho", "volumes_per_knot")})


@pytest.mark.parametrize("change", OTHERS)
def test_an_elite_with_another_number_is_not_proved(path, change):
    arrays, record = swing.elite()
    arrays = {key: np.array(value) for key, value in arrays.items()}
    record = {key: value.copy() if isinstance(value, dict | list) else value for key, value in record.items()}
    changed, told = OTHERS[change]
    changed(arrays, record)
    found = standing_of(path, Elite.of(arrays, record))
    assert found.verdict == "of another elite"
    assert f"{path} is of another elite: {told}" in found.reason
    assert not found.proved
    assert not found.claim


def test_rates_may_differ_by_their_rounding_alone(path, content):
    """A claim's rates are sines of another machine; a resealed last bit is another claim, but of the same elite."""
    content["claim"]["rates"][1][0][1] = nudged(content["claim"]["rates"][1][0][1], 2.0**-52)
    path.write_text(json.dumps(resealed(content)))
    assert standing_of(path, Elite.of(*swing.elite())).verdict == "proved"
    content["claim"]["rates"][1][0][1] = nudged(content["claim"]["rates"][1][0][1], 1e-9)
    path.write_text(json.dumps(resealed(content)))
    assert "rates[1][0][1] = " in standing_of(path, Elite.of(*swing.elite())).reason


DAMAGED = {
    "half a file": lambda text: text[: len(text) // 2],
    "nothing": lambda text: "",
    "another object": lambda text: "{}",
    "no object": lambda text: "[1, 2]",
    "no text": lambda text: text.replace("pendulum", "péndulum"),
    "a changed gain": lambda text: _changed(text, lambda c: c["claim"]["K"][2]),
    "a changed interval": lambda text: _changed(text, lambda c: c["funnel"][1]["first"][0]),
}


def _changed(text, container):
    content = json.loads(text)
    container(content)[0] = nudged(container(content)[0])
    return json.dumps(content)


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_file_proves_nothing(path, text, damage):
    path.write_text(DAMAGED[damage](text), "utf-8")
    assert standing_of(path, Elite.of(*swing.elite())).verdict == "damaged"


def test_a_refused_file_proves_nothing(path, content):
    content["goal"]["shells"][0]["cases"]["free"]["gram"][0][0] = "-0x1.0p+0"
    path.write_text(json.dumps(resealed(content)))
    found = standing_of(path, Elite.of(*swing.elite()))
    assert (found.verdict, found.sha256) == ("refused", "")
    assert "is not positive definite" in found.reason


def test_a_verdict_is_remembered_by_the_user_not_by_the_run(path, content, unremembered, monkeypatch):
    stored = swing.elite()
    first, checked = intervals_checked(path, stored)
    assert (first.proved, checked) == (True, len(content["funnel"]))
    assert intervals_checked(path, stored) == (first, 0)
    assert [file.name for file in path.parent.iterdir() if file.is_file()] == ["000.json"]
    monkeypatch.setattr(standing, "checker_digest", lambda: "another")
    assert intervals_checked(path, stored) == (first, len(content["funnel"]))


def test_what_is_remembered_of_one_file_says_nothing_of_another(path, content, unremembered):
    stored = swing.elite()
    assert standing_of(path, Elite.of(*stored)).proved
    content["funnel"][1]["cases"]["free"]["gram"][0][0] = "-0x1.0p+0"
    path.write_text(json.dumps(resealed(content)))
    assert standing_of(path, Elite.of(*stored)).verdict == "refused"
    path.unlink()
    assert standing_of(path, Elite.of(*stored)).verdict == "missing"


@pytest.mark.parametrize("rest", ["", "{", "[]", '{"verdict": "proved", "more": 1}'])
def test_a_torn_memory_is_none(path, content, unremembered, tmp_path, rest):
    stored = swing.elite()
    first = standing_of(path, Elite.of(*stored))
    (memory,) = (tmp_path / "empty").rglob("*.json")
    memory.write_text(rest)
    assert intervals_checked(path, stored) == (first, len(content["funnel"]))


def test_without_a_cache_it_is_decided_anew(path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    assert standing_of(path, Elite.of(*swing.elite())).proved
    assert intervals_checked(path, swing.elite())[1] > 0
