"""Each promise of SECURITY.md has its tests, and each rule its mutants."""

import ast
import re
from pathlib import Path

import pytest

from benchmarks.reader_rules import RULES

ROOT = Path(__file__).parents[3]
UNIT = "tests/unit/capture4d"
TESTS = {
    "No code of a file is run": [
        f"{UNIT}/body/test_pickled_arrays.py::test_a_hostile_pickle_is_one_line",
        f"{UNIT}/files/test_arrays.py::test_a_claim_that_has_no_bytes_is_refused",
    ],
    "A file does not choose what is read": [
        f"{UNIT}/files/test_reading.py::test_outside_of_it_nothing_is_read",
        f"{UNIT}/files/test_reading.py::test_links_are_followed_before_that_is_judged",
        f"{UNIT}/files/test_reading.py::test_the_command_lets_a_name_lead_outside",
    ],
    "What is no file is not opened": [f"{UNIT}/files/test_reading.py::test_what_is_no_file_is_not_opened"],
    "What a header claims is compared with the bytes that are there": [
        f"{UNIT}/files/test_arrays.py::test_a_claim_that_has_no_bytes_is_refused",
        f"{UNIT}/files/test_arrays.py::test_an_archive_that_unpacks_to_more_than_is_believed_is_refused",
        f"{UNIT}/files/test_arrays.py::test_arrays_that_lie_over_each_other_are_refused",
        f"{UNIT}/cli/test_hostile_files.py::test_a_hostile_file_is_one_line",
    ],
    "Pictures are no larger than their bytes allow": [
        f"{UNIT}/files/test_pictures.py::test_an_image_that_claims_more_pixels_than_its_bytes_hold_is_refused",
        f"{UNIT}/files/test_pictures.py::test_what_is_none_of_the_named_formats_is_not_opened",
    ],
    "Values that cannot be are refused": [
        "tests/property/test_damaged_files.py::test_what_breaks_a_rule_is_refused",
        f"{UNIT}/test_types.py::test_what_scales_mirrors_or_shears_is_no_rotation",
    ],
    "What is wrong is one line": [
        "tests/property/test_damaged_files.py::test_a_damaged_file_has_a_value_or_is_named",
        "tests/property/test_damaged_files.py::test_a_file_that_lies_has_a_value_or_is_named",
        f"{UNIT}/cli/test_hostile_files.py::test_a_hostile_file_is_one_line",
    ],
    "Inputs are not written to": [f"{UNIT}/cli/test_hostile_files.py::test_a_hostile_file_is_one_line"],
    "Two commands never write to one place": [
        f"{UNIT}/runs/test_locks.py::test_two_commands_on_one_work_folder",
        f"{UNIT}/runs/test_locks.py::test_the_second_is_refused_and_a_kill_frees_the_place",
    ],
    "A later version's work is not guessed at": [
        f"{UNIT}/runs/test_stage.py::test_a_record_of_a_later_version_is_refused"
    ],
    "Nothing is sent anywhere": ["tests/unit/docs/test_security.py::test_nothing_of_ours_speaks_to_the_net"],
}
"""Promises, as SECURITY.md has them in bold, and what holds them."""


def text() -> str:
    return (ROOT / "SECURITY.md").read_text()


def test_every_promise_names_its_tests() -> None:
    promised = re.findall(r"^- \*\*(.+?)[.,]?\*\*", text().partition("### ")[0], re.M)
    assert promised == list(TESTS)


@pytest.mark.parametrize("name", sorted({name for names in TESTS.values() for name in names}))
def test_a_test_that_is_named_is_there(name: str) -> None:
    path, _, function = name.partition("::")
    tree = ast.parse((ROOT / path).read_text())
    assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_rule_has_its_mutants() -> None:
    rules = text().partition("### What a value must be")[2].partition("What is not promised")[0]
    said = [" ".join(rule.split()) for rule in re.findall(r"^- (.+?)(?=^- |\Z)", rules, re.M | re.S)]
    assert len(said) == len(RULES)
    for sentence, rule in zip(said, RULES, strict=True):
        assert sentence.startswith(rule.name), (sentence, rule.name)


def test_nothing_of_ours_speaks_to_the_net() -> None:
    speaking = {"socket", "ssl", "http", "urllib.request", "requests", "urllib3", "ftplib", "smtplib", "httpx"}
    for package in ("capture4d", "data_synth", "registration", "retarget", "wrinkles"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert not speaking & set(names), path
