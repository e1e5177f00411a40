"""One small run folder with a proved elite, for all tests of certificates."""

import json

import pytest

from rtcd_jax.certificate.prove.certify import certify_elite
from tests.certificate import swing
from tests.certificate.folder import folder_with


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run folder whose elite 000 is certified."""
    folder = folder_with(tmp_path_factory.mktemp("run"), *swing.elite())
    certify_elite(folder, "000", "proved", lambda step: None)
    return folder


@pytest.fixture(scope="session")
def text(run):
    """The certificate's file."""
    return (run / "certificates" / "000.json").read_text()


@pytest.fixture
def content(text):
    """The certificate, to be changed at will."""
    return json.loads(text)
