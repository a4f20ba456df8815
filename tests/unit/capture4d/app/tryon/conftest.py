"""Garments that were learned in a moment: a tube of cloth on a limb."""

from pathlib import Path

import pytest

from capture4d.app.tryon.garments import TriedGarment, open_garment
from capture4d.captures.drapes.style_sets import StyleSet
from retarget.mixture import stage
from retarget.mixture.config import NetworkConfig, StylesConfig
from tests.unit.retarget.conftest import (  # noqa: F401
    body,
    garment,
    learned,
    make_world,
    motion,
    quick,
    works,
    write_work,
)
from tests.unit.retarget.mixture.conftest import made_style_set, write_style_set


@pytest.fixture(scope="session")
def style_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("styles")
    styles: StyleSet = made_style_set()
    write_style_set(folder / "set", styles)
    config = StylesConfig(members=1, network=NetworkConfig(hidden=8, epochs=4), checkpoint_every=2)
    return stage.run(folder / "set", folder / "model", config).path


@pytest.fixture(scope="session")
def tried(learned: Path) -> TriedGarment:  # noqa: F811
    return open_garment(learned)


@pytest.fixture(scope="session")
def styled(style_model: Path) -> TriedGarment:
    return open_garment(style_model)
