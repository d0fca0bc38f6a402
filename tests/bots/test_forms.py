"""Which buttons of a page a bot can press."""

from __future__ import annotations

from random import Random

import pytest

from hippodrome.bots import form_filling, forms

HIDDEN = [
    "<button hidden>Go</button>",
    "<input type=submit hidden>",
    "<button disabled>Go</button>",
    "<fieldset disabled><button>Go</button></fieldset>",
    "<button style='color: red; display:none'>Go</button>",
    "<div style='visibility: hidden'><p><button>Go</button></p></div>",
    "<section hidden><ul><li>x</ul><button>Go</button></section>",
    "<div inert><button>Go</button></div>",
    "<dialog><button>Go</button></dialog>",
    "<template><button>Go</button></template>",
    "<noscript><button>Go</button></noscript>",
    "<button form=other>Go</button>",
    "<button type=button>Go</button><button type=reset>Go</button>",
    "<div hidden>never closed<button>Go</button>",
]
SHOWN = [
    "<button>Go</button>",
    "<input type=image src=a.png>",
    "<div hidden>x</div><button>Go</button>",
    "<details><button>Go</button></details>",
    "<dialog open><button>Go</button></dialog>",
    "<p hidden>x<div><button>Go</button></div>",
    "<ul><li hidden>x<li><button>Go</button></ul>",
    "<table><tr hidden><td>x<tr><td><button>Go</button></table>",
    "<img hidden><button>Go</button>",
    "<button style='display: block'>Go</button>",
    "<div style='--display: none'><button>Go</button></div>",
]


def form(content: str) -> forms.Form:
    return forms.read(f"<form method=post>{content}</form>")[0]


@pytest.mark.parametrize("content", HIDDEN)
def test_a_page_whose_buttons_are_hidden_or_disabled_cannot_be_sent(content: str) -> None:
    assert not form(content).can_be_sent


@pytest.mark.parametrize("content", SHOWN)
def test_a_page_with_a_button_to_press_can_be_sent(content: str) -> None:
    assert form(content).can_be_sent


@pytest.mark.parametrize(
    "also", ["<script>show()</script>", "<style>:checked~*{display:block}</style>", "<link rel=stylesheet href=a.css>"]
)
def test_a_script_or_a_style_may_show_what_the_tags_hide(also: str) -> None:
    assert form(f"<button hidden>Go</button>{also}").can_be_sent
    assert not form("<button hidden>Go</button><style>p{color:red}</style>").can_be_sent


def test_a_button_that_is_shown_is_pressed_before_one_that_is_hidden() -> None:
    page = form("<button name=b value=hidden hidden>x</button><button name=b value=shown>x</button><script></script>")
    assert {str(form_filling.fill(page, Random(at))) for at in range(20)} == {"[('b', 'shown')]"}
