"""Pages: parts put together by the shared skeleton, escaped, alone on the network, and narrow enough for a phone."""

import re
from html.parser import HTMLParser

import jinja2
import pytest

from capture4d.app.drawing.page import Badge, Chart, Column, Film, Table, Tile, render_page

VOID = {"meta", "img", "input", "path"}


class Balanced(HTMLParser):
    """Every element that is opened is closed, in order."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


PAGE = """{% extends "page.html.jinja" %}
{% import "parts.html.jinja" as parts %}
{% block content %}
{{ parts.tiles(tiles) }}{{ parts.table(table) }}{{ parts.charts(charts) }}{{ parts.film(film) }}
{% endblock %}
{% block script %}{{ parts.film_script() }}{% endblock %}
"""


@pytest.fixture
def page(monkeypatch):
    """A page of all parts, whose texts would do harm if they were not escaped."""
    loader = jinja2.PackageLoader
    monkeypatch.setattr(
        jinja2, "PackageLoader",
        lambda name, place: jinja2.DictLoader({"own.html.jinja": PAGE}) if name == "own" else loader(name, place),
    )  # fmt: skip
    return render_page(
        "own", "own.html.jinja", title="<b>take</b>", subtitle="one & two",
        tiles=[Tile("1.2", "mm", "<i>fit</i>")],
        table=Table([Column("frames"), Column("fit", True)], [["1-3", Badge("lost")], ["<4>", "1"]], stacks=True),
        charts=[Chart("a curve", '<svg viewBox="0 0 1 1"><path d="M0 0"/></svg>')],
        film=Film("a film", "data:image/webp;base64,AAAA", ["data:a", "data:b"], ['frame "0"', "frame 1"], "plays"),
    )  # fmt: skip


def test_texts_are_escaped_and_elements_closed(page):
    assert "<b>take" not in page
    assert "<i>fit" not in page
    assert "one &amp; two" in page
    assert "frame &#34;0&#34;" in page
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []


def test_nothing_is_fetched(page):
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "http" not in page
    assert "@import" not in page


def test_words_that_mean_a_verdict_have_its_colour(page):
    assert '<span class="badge failed">lost</span>' in page
    assert Badge("warning").colour == "check"
    assert Badge("good").colour == "good"
    assert Badge("no such word").colour == ""
    assert Badge("no such word", "failed").colour == "failed"


def test_a_page_is_made_for_narrow_screens(page):
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in page
    assert '<td data-head="frames">1-3</td>' in page, "stacked rows name their cells"
    assert 'class="number" data-head="fit"' in page


def test_a_film_has_a_slider_over_all_frames(page):
    assert 'type="range" min="0" max="1"' in page
    assert page.count("data-uri=") == 2
    assert page.count("<script>") == 1


def test_what_a_template_asks_for_has_to_be_given(monkeypatch):
    monkeypatch.setattr(jinja2, "PackageLoader", lambda name, place: jinja2.DictLoader({"own": "{{ nothing }}"}))
    with pytest.raises(jinja2.UndefinedError, match="nothing"):
        render_page("own", "own", title="x")
