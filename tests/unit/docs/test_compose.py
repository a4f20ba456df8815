"""The compose file of the cluster is what the page about clusters says; no Docker is needed to read it."""

from pathlib import Path

import yaml

from capture4d.runs.cluster.worker_side import THREAD_VARIABLES

ROOT = Path(__file__).parents[3]
COMPOSE = ROOT / "examples" / "cluster" / "compose.yaml"


def services() -> dict:
    return yaml.safe_load(COMPOSE.read_text())["services"]


def test_a_scheduler_two_workers_and_a_command() -> None:
    found = services()
    assert set(found) == {"scheduler", "worker", "command"}
    assert found["worker"]["deploy"]["replicas"] == 2
    assert "tcp://scheduler:8786" in found["worker"]["command"]
    assert "--nthreads 1" in found["worker"]["command"], "workers with more threads are refused"
    assert "--port 8786" in found["scheduler"]["command"]
    assert found["command"]["profiles"], "it is run by hand, not with `up`"


def test_all_share_one_folder_and_compute_on_one_thread() -> None:
    for service in services().values():
        assert service["volumes"] == ["shared:/shared"]
        assert {service["environment"][name] for name in THREAD_VARIABLES} == {"1"}
        assert "/source[cluster]" in service["build"]["dockerfile_inline"]


def test_its_context_is_this_project_and_the_page_names_it() -> None:
    context = services()["worker"]["build"]["context"]
    assert (COMPOSE.parent / context / "pyproject.toml").is_file()
    assert str(COMPOSE.relative_to(ROOT)) in (ROOT / "docs" / "how-to" / "cluster.md").read_text()
