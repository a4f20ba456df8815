"""Files around the code that name commands and versions name those of the code."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[3]


def loaded(name: str):
    return yaml.safe_load((ROOT / name).read_text())


def test_the_version_to_cite_is_ours():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = loaded("CITATION.cff")
    assert (cited["title"], cited["version"], cited["license"]) == (
        project["name"], project["version"], project["license"],
    )  # fmt: skip


def test_a_commit_runs_what_lint_runs():
    """`make lint` over all files, hooks over those of the commit."""
    rule = re.search(r"^lint: .*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert rule
    linted = [line.strip().replace("$(BIN)", ".venv/bin").removesuffix(" .") for line in rule[1].splitlines()]
    hooks = [
        hook["entry"].replace(" --force-exclude", "") for hook in loaded(".pre-commit-config.yaml")["repos"][0]["hooks"]
    ]
    assert hooks == linted


def test_the_public_ci_calls_ours():
    steps = loaded(".github/workflows/ci.yml")["jobs"]["ci"]["steps"]
    assert "bash .ci/run" in [step.get("run") for step in steps]
    assert "make docs" in (ROOT / ".ci" / "run").read_text()


def test_who_reports_a_fault_is_asked_for_the_doctor():
    form = loaded(".github/ISSUE_TEMPLATE/fault.yml")
    asked = [part for part in form["body"] if "capture4d doctor" in part["attributes"]["label"]]
    assert [part["validations"]["required"] for part in asked] == [True]


def test_the_site_loads_nothing_from_the_net():
    site = loaded("mkdocs.yml")
    assert site["strict"] is True
    assert site["theme"]["font"] is False
    assert not {"extra_css", "extra_javascript", "site_url"} & set(site)
    assert "analytics" not in site["extra"]
