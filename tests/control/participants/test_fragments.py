"""Step pages are prepared for the frame, and filled in."""

from __future__ import annotations

import time
from html.parser import HTMLParser
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hippodrome.control.participants.fragments import prepare
from hippodrome.control.participants.sandbox import FragmentError, records_mentioned, uses_jinja

BASE = "/steps/demo/"


class Tags(HTMLParser):
    """The tags that an independent parser finds."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))

    def named(self, *names: str) -> list[dict[str, str | None]]:
        return [attrs for tag, attrs in self.seen if tag in names]


MARKS = [
    "<",
    ">",
    "/",
    "=",
    '"',
    "'",
    "<!--",
    "-->",
    "<![CDATA[",
    "<?php",
    "{{",
    "}}",
    "{%",
    "%}",
    "{#",
    "#}",
    "srcset='",
    "body",
    "x",
    "é",
]
TAGS = ["<form>", "</form>", "<script>", "</script", "<img src=", "<input name=x>", "<title>", "<svg", "<a href"]
pieces = st.sampled_from([*MARKS, *TAGS, " ", "\n", "\0", "\ue000", "\ue0000\ue001"])
soup = st.lists(pieces | st.text(max_size=5), max_size=40).map("".join)


@given(st.text() | soup)
@example("<![")
@example("<a " * 1000)
@example("\ue0005\ue001")
def test_any_text_can_be_prepared(text: str) -> None:
    prepared = prepare(text, BASE)
    assert prepared.text.count("\n") == text.count("\n")  # so that Jinja's line numbers are the researcher's


@given(soup)
def test_no_tag_or_comment_is_left_open_to_swallow_the_frame(text: str) -> None:
    plain = text.translate(dict.fromkeys(map(ord, "{}"), ""))
    after = Tags(prepare(plain, BASE).render({}) + '<button id="ours">')
    assert {"id": "ours"} in after.named("button")


@pytest.mark.parametrize("end", ["", "-", "!>", ">x", "-!>", "--!", "x>"])
def test_a_comment_that_is_left_open_is_closed(end: str) -> None:
    source = f"<p>a<!-- {end}"
    assert prepare(source, BASE).render({}) == source + "-->"


def test_a_comment_without_a_space_is_no_closed_one() -> None:
    assert prepare("<!--!>", BASE).render({}) == "<!--!>-->"


@pytest.mark.parametrize(
    ("source", "end"),
    [
        ("<select name=a><option>1", "</select>"),
        ("<select><option>1</select>", ""),
        ("{% if 1 %}<SELECT><option>1</option>{% endif %}<p>x</p>", "</select>"),
    ],
)
def test_a_select_that_is_left_open_is_closed(source: str, end: str) -> None:
    shown = source.replace("{% if 1 %}", "").replace("{% endif %}", "")
    assert prepare(source, BASE).render({}) == shown + end


@given(st.text(alphabet=st.characters(exclude_characters="<{\0", exclude_categories=["Cs"])))
def test_text_without_tags_is_unchanged(text: str) -> None:
    assert prepare(text, BASE).render({}) == text


@pytest.mark.parametrize("size", [200_000])
@pytest.mark.parametrize("piece", ["{{", "<!--", '<a ="', "<script>", "</", "<", "{% a", "<img srcset='a, "])
def test_the_time_for_a_page_does_not_grow_with_the_square_of_its_length(piece: str, size: int) -> None:
    began = time.thread_time()
    prepare(piece * (size // len(piece)), BASE)
    assert time.thread_time() - began < 3


# Tags that are left out


def test_tags_of_a_whole_document_are_left_out_and_their_contents_stay() -> None:
    source = (
        '<!DOCTYPE html><HTML lang="de"><head><meta charset=x><base href="/a"><title>Zu &amp; auf</title>'
        "<style>b{c:d}</style></head><body class=x><form action='http://evil.example' method=get\n>Text</FORM ></body></html>"
    )
    filled = prepare(source, BASE).fill({})
    assert filled.html == "<style>b{c:d}</style>Text"
    assert (filled.title, filled.lang) == ("Zu & auf", "de")


def test_a_drawing_keeps_its_title() -> None:
    source = "<svg><title>A horse</title></svg>"
    assert prepare(source).fill({}).html == source
    assert prepare(source).fill({}).title == ""


def test_tags_inside_scripts_comments_and_text_fields_are_text() -> None:
    source = "<!-- <form> --><textarea name=a><form></textarea><style>/* </form> */</style>"
    assert prepare(source).render({}) == source


@pytest.mark.parametrize(
    ("source", "ends"),
    [
        ("<textarea>x", "</textarea>"),
        ("<script>x", "</script>"),
        ("<script>x</script y", "<script>x</script y</script>"),
        ("<!-- x", "<!-- x-->"),
        ("<!-- x <p>", "<!-- x <p>-->"),
        ("x <b", "x &lt;b"),
        ("x </b", "x &lt;/b"),
    ],
)
def test_unclosed_elements_and_comments_are_closed_or_become_text(source: str, ends: str) -> None:
    assert prepare(source).render({}).endswith(ends)


# Fields and buttons


@pytest.mark.parametrize(
    ("source", "fields", "submit"),
    [
        ("<p>Hello</p>", False, False),
        ("<input>", False, False),
        ("<input name>", False, False),
        ("<input name='  '>", False, False),
        ("<input name=a>", True, False),
        ("<select name=a>", True, False),
        ("<textarea name=a></textarea>", True, False),
        ("<button>Go</button>", False, True),
        ('<button type="submit" name=a>Go</button>', True, True),
        ("<button type=button>No</button>", False, False),
        ("<button type=' Reset '>No</button>", False, False),
        ("<INPUT TYPE=SUBMIT>", False, True),
        ("<input type='image' src=a.png>", False, True),
        ("<input type=reset>", False, False),
        ("<!-- <button>Go</button> -->", False, False),
        ('<p title="<button>">', False, False),
        ("<button form=other>No</button>", False, False),  # it sends another form
        ("<input type=submit form=''>", False, False),
        ("<template><button>No</button></template>", False, False),
        ("<noscript><button>No</button></noscript>", False, False),
        ("<noscript></noscript><button>Go</button>", False, True),
        ("<textarea><button>No</button></textarea>", False, False),
        ("<button hidden>Go</button>", False, True),  # the page's own script may show it
        ("{% if no %}<input name=a><button>Go</button>{% endif %}", False, False),
        ("{% if no %}{% else %}<input name=a><button>Go</button>{% endif %}", True, True),
        ("{# <button>Go</button> #}", False, False),
        ("{{ '<button>' }}", False, False),
        ("{% macro go() %}<button>Go</button>{% endmacro %}", False, False),
        ("{% macro go() %}<button>Go</button>{% endmacro %}{{ go() }}", False, True),
    ],
)
def test_fields_and_buttons_are_those_that_the_participant_sees(source: str, fields: bool, submit: bool) -> None:
    filled = prepare(source).fill({})
    assert (filled.has_fields, filled.has_submit) == (fields, submit)


@pytest.mark.parametrize("shown", [True, False])
def test_heading_title_and_language_are_those_of_the_branch_that_is_shown(shown: bool) -> None:
    source = (
        "{% if x %}<html lang=de><title>Eins</title><h1>1</h1>{% else %}<html lang=fr><title>Deux</title>{% endif %}"
    )
    filled = prepare(source).fill({"x": shown})
    assert (filled.lang, filled.title, filled.has_heading) == (("de", "Eins", True) if shown else ("fr", "Deux", False))


@pytest.mark.parametrize("left", ["<textarea>", "<!-- ", "<script>", "<title>", "<p"])
def test_what_one_branch_leaves_open_does_not_swallow_the_frame(left: str) -> None:
    source = f"{{% if x %}}{left}{{% else %}}<p></textarea></script></title> -->{{% endif %}}"
    assert {"id": "ours"} in Tags(prepare(source).render({"x": 1}) + '<button id="ours">').named("button")


# Addresses


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('<img src="cat.png">', '<img src="/steps/demo/cat.png">'),
        ("<img alt=x src=./cat.png>", "<img alt=x src=/steps/demo/cat.png>"),
        ("<img src=X.png>", "<img src=/steps/demo/X.png>"),  # no letter at the beginning is taken away
        ("<img src='https://a.example/cat.png'>", "<img src='https://a.example/cat.png'>"),
        ('<img src="//a.example/cat.png">', '<img src="//a.example/cat.png">'),
        ('<img src="/x.png">', '<img src="/x.png">'),
        ('<img src="data:image/png;base64,AA">', '<img src="data:image/png;base64,AA">'),
        ('<img src="">', '<img src="">'),
        ('<img src="cat-{{ group }}.png">', '<img src="/steps/demo/cat-1.png">'),
        ('<img src="{{ project.picture }}">', '<img src="">'),
        ('<img srcset="a.png 1x, b.png 2x">', '<img srcset="/steps/demo/a.png 1x, /steps/demo/b.png 2x">'),
        ('<img srcset="data:image/png;base64,AA 1x">', '<img srcset="data:image/png;base64,AA 1x">'),
        ('<video poster=p.jpg src="v.mp4">', '<video poster=/steps/demo/p.jpg src="/steps/demo/v.mp4">'),
        ('<source src="a.ogg"><audio src="b.mp3">', '<source src="/steps/demo/a.ogg"><audio src="/steps/demo/b.mp3">'),
        ('<link rel=stylesheet href="x.css">', '<link rel=stylesheet href="/steps/demo/x.css">'),
        ('<a href="page.html">', '<a href="page.html">'),
        ("<img data-src=cat.png>", "<img data-src=cat.png>"),
        ("<imgx src=cat.png>", "<imgx src=cat.png>"),
    ],
)
def test_relative_addresses_point_to_the_projects_files(source: str, expected: str) -> None:
    assert prepare(source, BASE).render({"group": 1}) == expected


# Scripts


OPENS = ' target="_blank" rel="noopener"'


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('<a href="sheet.pdf">x</a>', f'<a{OPENS} href="/steps/demo/sheet.pdf">x</a>'),
        ("<A HREF=./Sheet.PDF#page=2>x</A>", f"<A{OPENS} HREF=/steps/demo/Sheet.PDF#page=2>x</A>"),
        ('<a href="/steps/demo/sheet.pdf">x</a>', f'<a{OPENS} href="/steps/demo/sheet.pdf">x</a>'),
        ('<a href="sheet-{{ group }}.pdf">x</a>', f'<a{OPENS} href="/steps/demo/sheet-{{{{ group }}}}.pdf">x</a>'),
        ('<area href="map.png"/>', f'<area{OPENS} href="/steps/demo/map.png"/>'),
        ('<a href="sheet.pdf" target="_self">x</a>', '<a href="/steps/demo/sheet.pdf" target="_self">x</a>'),
        ('<a href="sheet.pdf" download>x</a>', '<a href="/steps/demo/sheet.pdf" download>x</a>'),
    ],
)
def test_a_link_to_a_file_opens_it_in_a_tab_unless_the_author_says_otherwise(source: str, expected: str) -> None:
    assert prepare(source, BASE).text == expected


@pytest.mark.parametrize(
    "address",
    ["#part", "?userId=x", "next?projectId=x.pdf", "/other/x.pdf", "https://a.example/x.pdf", "more.html", ""],
)
def test_other_links_stay_unchanged(address: str) -> None:
    source = f'<a href="{address}">x</a>'
    assert prepare(source, BASE).text == source


def test_scripts_of_the_page_get_the_nonce() -> None:
    text = prepare('<script>a()</script><script src="b.js"></script>', BASE).render({}, "N")
    assert text == '<script nonce="N">a()</script><script nonce="N" src="/steps/demo/b.js"></script>'


def test_scripts_of_other_hosts_get_the_nonce_only_if_the_project_allows_the_host() -> None:
    hosts = ("https://good.example",)
    addresses = [
        "https://good.example/a.js",
        "https://bad.example/a.js",
        "//bad.example/a.js",
        "https://good.example.bad/a.js",
    ]
    found = [Tags(prepare(f'<script src="{each}"></script>', BASE, hosts).render({}, "N")) for each in addresses]
    assert ["nonce" in each.named("script")[0] for each in found] == [True, False, False, False]


@pytest.mark.parametrize(
    "address",
    [
        "/\t/bad.example/a.js",
        "\n//bad.example/a.js",
        "\\\\bad.example/a.js",
        "https:///bad.example/a.js",
        "HTTPS:\\\\bad.example/a.js",
    ],
)
def test_an_address_that_browsers_read_as_another_host_gets_no_nonce(address: str) -> None:
    (script,) = Tags(prepare(f'<script src="{address}"></script>', BASE).render({}, "N")).named("script")
    assert "nonce" not in script


def test_a_script_whose_address_is_a_value_gets_no_nonce() -> None:
    page = prepare('<script src="{{ x }}"></script>', BASE)
    assert page.render({"x": "//bad.example/a.js"}, "N") == '<script src="//bad.example/a.js"></script>'


def test_an_authors_nonce_has_no_effect() -> None:
    assert prepare('<script nonce="old">1</script>').render({}, "N").startswith('<script nonce="N" nonce="old">')


def test_a_page_for_clients_with_their_own_frame_has_no_nonce() -> None:
    assert prepare("<script>1</script>").render({}) == "<script>1</script>"


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text() | soup,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(value=json_values | st.just("<script>alert(1)</script>") | st.just('"><script nonce="N">'))
def test_a_value_is_never_a_tag(value: Any) -> None:
    source = '<p class="{{ answers["1"].x }}">{{ answers["1"].x }}</p><script>ours()</script>'
    tags = Tags(prepare(source).render({"answers": {"1": {"x": value}}}, "N"))
    assert [tag for tag, _ in tags.seen] == ["p", "script"]
    assert tags.named("script") == [{"nonce": "N"}]


@given(soup)
def test_a_value_that_is_shown_raw_gets_no_nonce(value: str) -> None:
    raw = f"<script>{value}</script><script>x</script>"
    text = prepare("{{ v|safe }}").render({"v": raw}, "SECRET")
    assert "SECRET" not in text


# Filling in


def test_a_page_without_expressions_is_no_template() -> None:
    source = "<style>@media print{#menu{display:none}}</style> { % } {x} 100 %}"
    assert prepare(source).render({}) == source


def test_an_unknown_value_is_shown_as_nothing() -> None:
    assert prepare("[{{ a }}{{ b.c.d }}{{ answers['9'].x.y }}]").render({"answers": {}}) == "[]"


def test_comparisons_and_texts_in_expressions_are_no_tags() -> None:
    source = "{% if a <b and b> a and '<form>' %}<i>{{ '<form>'|length }}{# <form> #}</i>{% endif %}"
    assert prepare(source).render({"a": 1, "b": 2}) == "<i>6</i>"
    assert prepare(source).text == source
    assert prepare("{% if a <b%}c{% endif %}").render({"a": 1, "b": 2}) == "c"


def test_expressions_in_attributes() -> None:
    source = "<input name=a {% if x > 1 %}checked{% endif %} value=\"{{ '>' }}\"><p>"
    assert prepare(source).render({"x": 2}) == '<input name=a checked value="&gt;"><p>'


def test_characters_of_private_use_stay_unchanged() -> None:
    assert prepare("\ue0000\ue001{{ 1 }}\ue000").render({}) == "\ue0000\ue0011\ue000"


@pytest.mark.parametrize(
    ("source", "line"),
    [
        ("<form\n>\n{{ 1 + }}", 3),
        ("a\n{% if x %}", 2),
        ("a\nb\n{{ 1 / 0 }}", 3),
        ("a\nb\n{{ 'x' ~ 1 / 0 }}", 3),
        ("{{ joiner()|tojson }}", 1),
        ("\n{{ x|nosuchfilter }}", 2),
        ("{{ name }", 1),
        ("{% for a in range(1000000) %}{% endfor %}", 1),
        ("{{ ().__class__.__base__.__subclasses__() }}", 1),
        ("{{ answers.update({}) }}", 1),
    ],
)
def test_a_page_that_fails_names_the_line(source: str, line: int) -> None:
    with pytest.raises(FragmentError) as caught:
        prepare(source).render({"answers": {"1": {}}})
    assert caught.value.line == line
    assert caught.value.message == str(caught.value)


def test_a_page_cannot_grow_without_limit() -> None:
    source = "{% for a in range(9999) %}{{ '0123456789' * 100 }}{% endfor %}"
    with pytest.raises(FragmentError, match="2 MB"):
        prepare(source).render({})


@given(soup)
def test_rendering_raises_fragment_error_only(text: str) -> None:
    try:
        prepare(text, BASE).render({"answers": {}}, "N")
    except FragmentError as error:
        assert error.message


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("nothing {{ project.name }}{{ completion_code }}", set()),
        ("{{ answers['1'].age }}", {"answers.1"}),
        ("{{ answers['1'].age }}{{ answers.finalStep }}", {"answers.1", "answers.finalStep"}),
        ("{{ answers['1'].age }}{{ answers|length }}", {"answers"}),
        ("{{ answers[group] }}", {"answers"}),
        ("{{ answers[1] }}", {"answers"}),
        ("{% for step in answers %}{{ answers['1'] }}{% endfor %}", {"answers"}),
        ("{% if participant.x %}{{ answers }}{% endif %}", {"answers", "participant"}),
        ("{% set answers = 1 %}{{ answers }}", set()),
        ("{# answers #}", set()),
        ("answers, participant", set()),
        ("{{ answers", set()),
        ("{{ answers|nosuchfilter }}", set()),
        ("{{ " + "(" * 5000 + " }}", set()),
    ],
)
def test_records_mentioned_finds_the_records_that_a_page_needs(source: str, expected: set[str]) -> None:
    assert records_mentioned(source) == expected


@given(st.text() | soup)
def test_records_mentioned_never_raises(text: str) -> None:
    assert all(need.partition(".")[0] in ("participant", "answers") for need in records_mentioned(text))


def test_an_unknown_value_is_null_in_scripts() -> None:
    text = prepare('const age = {{ answers["2"].age|tojson }}, x = {{ {"a": participant.b}|tojson }};').render({})
    assert text == 'const age = null, x = {"a": null};'


@pytest.mark.parametrize("name", ["script", "style", "textarea", "iframe", "xmp", "noembed", "noframes", "SCRIPT"])
def test_the_content_of_a_raw_element_is_text_up_to_its_own_end_tag(name: str) -> None:
    source = f"<{name}><form><b></{name}x></{name}\n><form><i>"
    assert prepare(source).render({}) == f"<{name}><form><b></{name}x></{name}\n><i>"
    assert prepare(f"<{name}><form>").render({}) == f"<{name}><form></{name.lower()}>"


@pytest.mark.parametrize("name", ["html", "head", "body", "form", "meta", "base", "FORM"])
def test_each_tag_of_a_whole_document_is_left_out(name: str) -> None:
    assert prepare(f"a<{name} x\n=1>b</{name}\n>c").render({}) == "abc"
    assert prepare("a<!DOCTYPE\nhtml>b<?xml\n?>c").render({}) == "abc"


@pytest.mark.parametrize(
    ("tag", "attribute"),
    [
        ("img", "src"),
        ("source", "src"),
        ("video", "src"),
        ("video", "poster"),
        ("audio", "src"),
        ("track", "src"),
        ("link", "href"),
        ("input", "src"),
    ],
)
def test_each_address_of_a_file_points_to_the_projects_files(tag: str, attribute: str) -> None:
    for written, expected in (("a.png", f"{BASE}a.png"), ("./a.png", f"{BASE}a.png"), ("/a.png", "/a.png")):
        assert prepare(f"<{tag} {attribute}={written}>", BASE).render({}) == f"<{tag} {attribute}={expected}>"
    assert prepare(f"<{tag} {attribute}=a.png>").render({}) == f"<{tag} {attribute}=a.png>", "no base is known"


@pytest.mark.parametrize("name", ["img", "source"])
def test_each_address_of_a_set_points_to_the_projects_files(name: str) -> None:
    found = prepare(f"<{name} srcset='a.png 1x,  b.png 2x, https://x.org/c.png 3x'>", BASE).render({})
    assert found == f"<{name} srcset='{BASE}a.png 1x,  {BASE}b.png 2x, https://x.org/c.png 3x'>"


def test_only_the_documents_own_title_is_taken_out() -> None:
    drawing = "<svg><title>circle</title></svg>"
    page = prepare(f"{drawing}<svg/><title> The \n {{{{ x }}}} page &amp; more </title>{drawing}").fill({"x": "<1>"})
    assert page.title == "The <1> page & more"
    assert page.html == f"{drawing}<svg/>{drawing}"
    assert prepare(f"<title>{'x' * 201}</title>").fill({}).title == "x" * 200


@pytest.mark.parametrize(
    ("lang", "kept"),
    [("de", "de"), ("zh-Hant-TW", "zh-Hant-TW"), ("x", ""), ("d\"e'", ""), ("a" * 35, "a" * 35), ("a" * 36, "")],
)
def test_the_language_of_the_page_is_one_that_a_page_can_have(lang: str, kept: str) -> None:
    assert prepare(f'<html lang="{lang}">').fill({}).lang == kept
    assert prepare(f'<html lang="en"><html lang="{lang}">').fill({}).lang == "en"


@pytest.mark.parametrize("source", ["a {# x #", "{# no end", "a }} b"])
def test_an_expression_that_never_ends_is_text(source: str) -> None:
    assert prepare(f"{source}<form>").render({}) == source


def test_a_zero_byte_is_shown_as_browsers_show_it() -> None:
    assert prepare("a\0b").text == "a\ufffdb"


def test_a_comment_of_jinja_is_no_part_of_the_page() -> None:
    assert prepare("a{# <form> {{ x }} #}b").render({"x": 1}) == "ab"
    assert prepare("a{# <form> #}b").render({}) == "ab"
    assert prepare("a{% if 1 < 2 %}<form>b{% endif %}").render({}) == "ab"
    css = "<style>@media print{#menu{color:red}}</style>"
    assert prepare(css).render({}) == css


@pytest.mark.parametrize(
    "source",
    [
        "{% for a in range(9999) %}{% for b in range(9999) %}{% endfor %}{% endfor %}",
        "{% for a in range(100001) %}{% endfor %}",
    ],
)
def test_a_page_that_loops_for_too_long_is_cut_off(source: str) -> None:
    with pytest.raises(FragmentError, match=r"the page's loops over range\(\) have more than 100000 rounds"):
        prepare(source).render({})


def test_each_page_has_its_own_loops() -> None:
    page = prepare("{% for a in range(60000) %}{% endfor %}{{ range(2, 9, 3)|list }}")
    assert page.render({}) == page.render({}) == "[2, 5, 8]"


@pytest.mark.parametrize("name", ["items", "keys", "values", "get", "copy", "update", "pop", "clear"])
@pytest.mark.parametrize("source", ["{{ x.NAME }}", "{{ x['NAME'] }}", "{{ [x]|map(attribute='NAME')|first }}"])
def test_a_value_named_like_a_method_is_that_value_and_without_one_nothing(name: str, source: str) -> None:
    page = prepare(f"[{source.replace('NAME', name)}]")
    assert page.render({"x": {name: "sword"}}) == "[sword]"
    assert page.render({"x": {}}) == "[]"


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("{% for name, value in x.items() %}{{ name }}={{ value }}{% endfor %}", "a=1"),
        ("{{ x.get('a') }}{{ x.get('b', 2) }}{{ x.keys()|list|length }}", "121"),
        ("{{ x.items|default('none') }}{{ 'yes' if x.values else 'no' }}", "noneno"),
        ("{{ x.a.bit_count }}{{ range }}{{ lipsum }}", ""),
    ],
)
def test_methods_can_be_called_and_are_never_shown(source: str, shown: str) -> None:
    assert prepare(source).render({"x": {"a": 1}}) == shown


def test_a_page_may_have_two_million_characters() -> None:
    assert len(prepare("{{ x }}").render({"x": "x" * 2_000_000})) == 2_000_000
    with pytest.raises(FragmentError, match="2 MB"):
        prepare("{{ x }}").render({"x": "x" * 2_000_001})


def work(source: str) -> float:
    """Return the processor seconds that preparing and filling a page takes: the smaller of two measurements."""
    times = []
    for _ in range(2):
        begun = time.process_time()
        page = prepare.__wrapped__(source, "/steps/maze/", ())
        if not uses_jinja(source):  # Jinja's own work is not ours
            page.fill({})
        times.append(time.process_time() - begun)
    return min(times)


@pytest.mark.parametrize("begin", ["", "<script>", "<title>", "<img srcset='"])
@pytest.mark.parametrize(
    "again",
    [
        "</script ",
        "</title\n",
        "<script></script ",
        "<a ",
        "</a ",
        "<!-- -",
        "a='b ",
        " a =  ",
        ",  ",
        "{{",
        "{# ",
        "\ue0001",
    ],
)
def test_the_work_for_a_page_grows_with_its_length_whatever_it_holds(begin: str, again: str) -> None:
    """Sixteen times the text: about sixteen times the work, and never near the square of it, 256 times."""
    short, long = (begin + again * (size // len(again)) for size in (4_000, 64_000))
    assert work(long) < 80 * max(work(short), 0.001)
