"""A fault keeps its file apart from its reason, whatever it travels through."""

import copy
import pickle

import pytest

from capture4d.errors import InputError, StaleError


@pytest.mark.parametrize("kind", [InputError, StaleError])
@pytest.mark.parametrize("travel", [copy.copy, lambda error: pickle.loads(pickle.dumps(error))])
def test_an_error_travels_whole(kind, travel):
    error = travel(kind("expected 3 numbers, found 2", where="rig.json"))
    assert type(error) is kind
    assert str(error) == "rig.json: expected 3 numbers, found 2"
    assert (error.where, error.reason) == ("rig.json", "expected 3 numbers, found 2")


def test_the_file_is_named_once_however_often_it_is_told():
    error = InputError("expected 3 numbers, found 2").at("a.json").at("b.json")
    assert str(error) == "b.json: expected 3 numbers, found 2"


def test_a_line_is_told_with_its_file():
    error = InputError("expected 3 numbers, found 2", line=7)
    assert str(error) == "expected 3 numbers, found 2"
    error = pickle.loads(pickle.dumps(error.at("a.obj")))
    assert (str(error), error.where) == ("a.obj:7: expected 3 numbers, found 2", "a.obj")


def test_a_message_is_one_line_whatever_a_file_held() -> None:
    for text in ("a\nb", "a\r\nb", "a\x1b[2Jb", "a\u2028b", "a\x85b", "a\udcffb", "a\0b"):
        error = InputError(f"found {text}", where=f"folder/{text}", line=3)
        assert str(error).isprintable()
        assert len(str(error).splitlines()) == 1
        assert error.reason.isprintable()
        assert error.where == f"folder/{text}"  # a path stays what it is
        str(error).encode()
    assert str(InputError("tête: 3 × 4", where="été.ply")) == "été.ply: tête: 3 × 4"
