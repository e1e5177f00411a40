"""`rtcd tolerance --prove`: the factor up to which certificates hold, its certificate, and what a kill leaves."""

import json

import pytest

from rtcd_jax.analysis.tolerance import proved as proofs
from rtcd_jax.analysis.tolerance.proved import proved_factor
from rtcd_jax.certificate import check
from rtcd_jax.config.schema import UncertaintyConfig
from tests.certificate import swing
from tests.certificate.folder import folder_with
from tests.consoles import Screen

BOX = UncertaintyConfig(input=0.1)


def found(run, most=100.0):
    return proved_factor(run, "tolerance", "000", BOX, most, Screen().console)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return folder_with(tmp_path_factory.mktemp("proved"), *swing.elite())


@pytest.mark.slow
def test_the_largest_proved_box_has_its_certificate(run, monkeypatch):
    """Killed in between, it goes on: no factor is proved twice."""
    monkeypatch.setattr(proofs, "PRECISE", 2.1)
    tried, certify = [], proofs.certify_elite

    def counted(folder, name, guarantee, tell, uncertainty, target):
        if len(tried) == 2 and "killed" not in tried:
            tried.append("killed")
            raise KeyboardInterrupt
        tried.append(uncertainty.input)
        return certify(folder, name, guarantee, tell, uncertainty=uncertainty, target=target)

    monkeypatch.setattr(proofs, "certify_elite", counted)
    with pytest.raises(KeyboardInterrupt):
        found(run)
    row = found(run)
    tried.remove("killed")
    assert len(set(tried)) == len(tried)
    assert not row["at_most"]
    assert 1 <= row["factor"] < min(w for w in tried if w > row["factor"] * 0.1 * 1.001) / 0.1 <= 2.1 * row["factor"]
    text = (run / "tolerance" / "certificates" / "000.json").read_text()
    claim = check.check(check.parse(text.encode()))
    assert float.fromhex(json.loads(text)["claim"]["disturbance"]) == pytest.approx(row["factor"] * 0.1)
    assert row["volumes"]["sum"] > 0
    assert claim is not None
    assert not list((run / "tolerance").glob(".*"))


@pytest.mark.thorough
def test_nothing_above_what_means_something_is_tried(run):
    row = found(run, most=0.5)
    assert (row["factor"], row["at_most"], row["guarantee"]) == (0.5, True, "proved")
