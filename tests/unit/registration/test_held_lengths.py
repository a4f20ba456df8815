"""Lengths alone: a sheet that was rolled and slid on itself comes back; what grew is no cloth."""

from dataclasses import replace

import numpy as np
import pytest

from capture4d.geometry.mesh import boundary_loops
from capture4d.types import Garment, GarmentScan, Mesh
from registration import mesh_fit
from registration.config import MeshRegistrationConfig, RegistrationConfig, Schedule, SettleConfig
from registration.held_lengths import keeps_lengths, slid
from registration.register import prepare_frame
from registration.template import analyse_template

LENGTH, WIDTH = 0.8, 0.5
NO_POINTS = (np.zeros((0, 3), np.float32), np.zeros(0, np.int32), (), 0)


def sheet(along: int, across: int) -> Mesh:
    """A flat sheet in X and Y, metres."""
    x, y = np.meshgrid(np.linspace(0, LENGTH, along), np.linspace(0, WIDTH, across), indexing="ij")
    corner = (np.arange(along - 1)[:, None] * across + np.arange(across - 1)).reshape(-1)
    a, b, c, d = corner, corner + across, corner + across + 1, corner + 1
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    points = np.column_stack([x.reshape(-1), y.reshape(-1), np.zeros(along * across)])
    return Mesh(points.astype(np.float32), faces.astype(np.int32))


def folded(points: np.ndarray) -> np.ndarray:
    """The sheet in waves of 0.4 m that rise and fall by 60 degrees: no length of it changes."""
    fine = np.linspace(0, LENGTH, 4001)
    slope = np.radians(60) * np.sin(2 * np.pi * fine / 0.4)
    x, z = (np.concatenate([[0.0], np.cumsum(step[:-1] * fine[1])]) for step in (np.cos(slope), np.sin(slope)))
    return np.column_stack([np.interp(points[:, 0], fine, x), points[:, 1], np.interp(points[:, 0], fine, z)])


def slipped(points: np.ndarray) -> np.ndarray:
    """Moved along itself, by up to 15 mm one way here and the other way there; its ends stay."""
    return np.column_stack([points[:, 0] + 0.015 * np.sin(2 * np.pi * points[:, 0] / LENGTH), points[:, 1:]])


def off(found: np.ndarray, true: np.ndarray) -> float:
    """Millimetres."""
    return float(1e3 * np.linalg.norm(found - true, axis=1).mean())


@pytest.fixture
def cloth() -> Garment:
    """With a slit in its middle: garments have two openings or more."""
    mesh = sheet(41, 26)
    middle = np.abs(mesh.vertices[mesh.faces].mean(axis=1)[:, :2] - (LENGTH / 2, WIDTH / 2)).max(axis=1) < 0.03
    mesh = Mesh(mesh.vertices, mesh.faces[~middle])
    return Garment(mesh, {f"border_{k}": loop for k, loop in enumerate(boundary_loops(mesh.faces))})


@pytest.fixture
def scan() -> GarmentScan:
    fine = sheet(161, 101)
    return GarmentScan(fine.with_vertices(folded(fine.vertices.astype(float)).astype(np.float32)), *NO_POINTS)


def test_what_was_slid_along_itself_slides_back(cloth: Garment, scan: GarmentScan, config: RegistrationConfig) -> None:
    analysis = analyse_template(cloth, config)
    alone = replace(config, coarse=replace(config.coarse, cold=Schedule(0, (0.03, 0.012))))
    true, start = folded(analysis.rest), folded(slipped(analysis.rest))
    found = slid(analysis, prepare_frame(analysis, scan, config), start, alone, (0.0, 0.0))
    assert off(found, true) < 0.2 * off(start, true)
    assert keeps_lengths(analysis, found)


def test_what_is_folded_keeps_its_lengths_and_what_grew_does_not(cloth: Garment, config: RegistrationConfig) -> None:
    analysis = analyse_template(cloth, config)
    assert keeps_lengths(analysis, folded(analysis.rest))
    assert not keeps_lengths(analysis, folded(slipped(analysis.rest)))
    assert not keeps_lengths(analysis, 1.08 * analysis.rest)


def quick(config: RegistrationConfig) -> MeshRegistrationConfig:
    return MeshRegistrationConfig(lengths="kept", align="none", registration=config, settle=SettleConfig(steps=4))


def test_a_sheet_that_was_folded_is_found_as_cloth(cloth: Garment, scan: GarmentScan, config, monkeypatch) -> None:
    """It lies on its scan, slid along it, so that no nodes need to carry it there."""
    rest = cloth.template.vertices.astype(np.float64)
    start, lies_there = folded(slipped(rest)), replace(config.coarse, cold=Schedule(0, (0.03, 0.012)))
    settings = quick(replace(config, coarse=lies_there))
    with_it = mesh_fit.fit_mesh(cloth, scan, start, settings).vertices
    monkeypatch.setattr(mesh_fit, "keeps_lengths", lambda *_: False)
    without = mesh_fit.fit_mesh(cloth, scan, start, settings).vertices
    assert off(with_it, folded(rest)) < min(2.0, 0.5 * off(without, folded(rest)))


@pytest.mark.parametrize("kind", ["open at one end", "painted"])
def test_what_has_fewer_borders_or_has_settled_on_painted_ones_is_no_such_cloth(
    kind: str, garment, scan_of, config, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> np.ndarray:
        raise AssertionError

    monkeypatch.setattr(mesh_fit, "slid", never)
    scan = scan_of(lambda points: points + 0.004)
    if kind == "open at one end":
        garment = Garment(garment.template, {"hem": garment.loops["hem"]})
        scan = GarmentScan(scan.mesh, *NO_POINTS)
    mesh_fit.fit_mesh(garment, scan, garment.template.vertices.astype(np.float64), quick(config))
