"""What was made lately: bounded, and the longest unasked goes first."""

import numpy as np

from capture4d.app.viewer.kept import Kept


def test_never_more_than_is_allowed_and_the_oldest_goes():
    kept, rng = Kept[bytes](1000, len), np.random.default_rng(0)
    lately: list[int] = []
    for key in rng.integers(0, 30, 2000).tolist():
        value = kept.get(key, lambda key=key: bytes(50 + 3 * key))
        assert len(value) == 50 + 3 * key
        lately = [*(each for each in lately if each != key), key]
        assert kept.bytes <= 1000
        there = [each for each in lately if each in kept]
        assert there == lately[len(lately) - len(there) :], "those asked for last are there"
        assert kept.bytes == sum(50 + 3 * each for each in there)


def test_made_once_while_it_is_there():
    kept, made = Kept[bytes](100, len), []
    for _ in range(3):
        kept.get("a", lambda: made.append(1) or b"x")
    assert made == [1]
    kept.clear()
    kept.get("a", lambda: made.append(1) or b"x")
    assert made == [1, 1]


def test_what_is_too_large_is_handed_on():
    kept = Kept[bytes](10, len)
    kept.get("small", lambda: b"1234")
    assert kept.get("large", lambda: bytes(11)) == bytes(11)
    assert "small" in kept
    assert "large" not in kept
