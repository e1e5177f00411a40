"""Documents lead where they say: relative links to files that are there, every page in the site's navigation."""

import os
import re
import subprocess

import pytest
import yaml

from tests.paths import ROOT

PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/*.md")),
    *sorted(ROOT.glob("launch/**/*.md")),
]
LINK = re.compile(r"\]\((?!https?://|#)([^)#\s]+)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_lead_to_files(page):
    targets = LINK.findall(page.read_text())
    assert [target for target in targets if not (page.parent / target).exists()] == []


@pytest.mark.parametrize("page", sorted(ROOT.glob("docs/*.md")), ids=lambda page: page.name)
def test_links_of_the_site_stay_in_it(page):
    assert [target for target in LINK.findall(page.read_text()) if target.startswith("..")] == []


def test_the_site_shows_every_page():
    def pages(entry):
        if isinstance(entry, str):
            return [entry]
        children = entry if isinstance(entry, list) else list(entry.values())
        return [page for child in children for page in pages(child)]

    navigation = pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    assert sorted(navigation) == sorted(path.name for path in ROOT.glob("docs/*.md"))


def test_the_readme_of_a_release_leads_to_its_tag_from_anywhere(tmp_path):
    """The release workflow's own step, on a copy."""
    steps = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text())["jobs"]["build"]["steps"]
    (command,) = (step["run"] for step in steps if "README.md" in step.get("run", ""))
    text = (ROOT / "README.md").read_text()
    (tmp_path / "README.md").write_text(text)
    of_the_tag = {"SERVER_URL": "https://git.example", "REPOSITORY": "lab/rtcd_jax", "REF_NAME": "v1.2.3"}
    told = os.environ | {f"GITHUB_{name}": value for name, value in of_the_tag.items()}
    subprocess.run(["bash", "-c", command], cwd=tmp_path, env=told, check=True)
    changed = (tmp_path / "README.md").read_text()
    assert LINK.findall(changed) == []
    for target in LINK.findall(text):
        kind = "raw" if re.search(rf"!\[[^]]*\]\({re.escape(target)}\)", text) else "blob"
        assert f"](https://git.example/lab/rtcd_jax/{kind}/v1.2.3/{target})" in changed
