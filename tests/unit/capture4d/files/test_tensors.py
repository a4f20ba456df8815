"""Tensors with a note: what is said of a file of other tensors stays short."""

from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.files.tensors import read_tensors, write_tensors

LONG = "x" * 5000


def test_what_is_missing_is_named_in_a_line_that_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, "test", {LONG: np.ones(2, np.float32)}, {LONG: 1})
    file = read_tensors(path, "test")
    for missing in (lambda: file["mean"], lambda: file[LONG + "y"], lambda: file.entry("layout")):
        with pytest.raises(InputError) as caught:
            missing()
        assert caught.value.where == str(path)
        assert "expected" in caught.value.reason
        assert len(caught.value.reason) < 400
    write_tensors(path, LONG, {}, {})
    with pytest.raises(InputError, match="expected test, found x") as caught:
        read_tensors(path, "test")
    assert len(caught.value.reason) < 400
