"""The forms of a page, read as a browser reads them. Pure."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from hippodrome.control.participants import markup

PRESSED = ("submit", "image")
"""Types of the buttons that send a form."""
_NEVER_SENT = ("reset", "button")
"""Types of the buttons that send nothing."""
_TIMES = ("date", "time", "datetime-local", "month", "week")
_TEXTS = ("text", "search", "password", "email", "url", "tel")
_TYPES = {*_TEXTS, *_TIMES, *PRESSED, *_NEVER_SENT, "color", "number", "range", "hidden", "radio", "checkbox", "file"}
"""Types of inputs. A browser takes any other type for `text`."""
_INERT = ("template", "noscript")
"""Elements whose content browsers do not show, and whose fields they do not send."""
_HIDING_STYLE = re.compile(r"(?:\A|;)\s*(?:display\s*:\s*none|visibility\s*:\s*(?:hidden|collapse))", re.IGNORECASE)
_SHOWING_STYLE = re.compile("display|visibility", re.IGNORECASE)
_BLOCKS = (
    "address", "article", "aside", "blockquote", "details", "div", "dl", "fieldset", "figure", "footer", "form",
    "h1", "h2", "h3", "h4", "h5", "h6", "header", "hr", "main", "nav", "ol", "p", "pre", "section", "table", "ul",
)  # fmt: skip
_ENDED_BY = {
    "li": ("li",),
    **dict.fromkeys(("dt", "dd"), ("dt", "dd")),
    **dict.fromkeys(("td", "th"), ("td", "th")),
    **dict.fromkeys(("tr", "tbody", "tfoot"), ("td", "th", "tr")),
    **dict.fromkeys(_BLOCKS, ("p",)),
}
"""Elements without an end tag that end where an element of this name begins."""


@dataclass(frozen=True)
class SelectOption:
    """One choice of a select."""

    value: str
    selected: bool = False
    disabled: bool = False


@dataclass
class Control:
    """An input, select, textarea or button; `kind` is the type of an input or button, or the name of the element."""

    kind: str
    attributes: Mapping[str, str]
    options: list[SelectOption] = field(default_factory=list)  # the options of a select
    text: str = ""  # the text of a textarea
    hidden: bool = False  # whether the page hides it

    @property
    def name(self) -> str:
        return self.attributes.get("name", "")

    @property
    def required(self) -> bool:
        return "required" in self.attributes

    @property
    def value(self) -> str:
        return self.attributes.get("value", "")


@dataclass
class Form:
    """A form of a page, without its disabled controls."""

    action: str
    method: str
    controls: list[Control] = field(default_factory=list)
    may_change: bool = False  # whether the page has scripts, or styles that may show what its tags hide

    @property
    def buttons(self) -> list[Control]:
        """The buttons that a participant can press. If none is shown and the page may change, all of them."""
        buttons = [control for control in self.controls if control.kind in PRESSED]
        shown = [button for button in buttons if not button.hidden]
        return shown or (buttons if self.may_change else [])

    @property
    def can_be_sent(self) -> bool:
        """Whether a participant may be able to send the form. A script could add a button, or enable one."""
        return bool(self.buttons) or self.may_change


def read(page: str) -> list[Form]:
    """Return the forms of a page in their order."""
    reader = _Reader()
    for token in markup.tokens(page):
        reader.text(token.before)
        if token.start and token.is_closed:
            reader.start(token)
        elif token.end:
            reader.end(token.end)
    return reader.all_forms()


def to_answer(page: str) -> Form | None:
    """Return the first form of a page that is sent by POST; None if the page has no such form."""
    return next((form for form in read(page) if form.method == "post"), None)


def hidden(form: Form) -> Iterator[tuple[str, str]]:
    """Yield the name and the value of each hidden field of a form."""
    return ((control.name, control.value) for control in form.controls if control.kind == "hidden")


class _Reader:
    """Gathers forms with their controls, as browsers do: it follows `form="…"` and disabled fieldsets."""

    def __init__(self) -> None:
        self._forms: list[Form] = []
        self._by_id: dict[str, Form] = {}
        self._form: Form | None = None
        self._by_form_id: list[tuple[str, Control]] = []  # controls that name their form by `form="…"`
        self._fieldsets: list[_Fieldset] = []
        self._select: Control | None = None
        self._option: dict[str, str] | None = None
        self._label: list[str] = []  # the text of the open option
        self._group_disabled = False
        self._open: list[tuple[str, bool]] = []  # open elements, and whether each is hidden

    def start(self, token: markup.Token) -> None:
        tag, attributes = token.start, markup.attributes(token.attributes)
        while self._open and self._open[-1][0] in _ENDED_BY.get(tag, ()):
            self._open.pop()
        self._open.append((tag, _is_hidden(tag, attributes)))
        if tag == "form" and self._form is None:
            self._form = Form(attributes.get("action", ""), attributes.get("method", "get").lower())
            self._forms.append(self._form)
            self._by_id.setdefault(attributes.get("id", ""), self._form)
        elif tag == "fieldset":
            self._fieldsets.append(_Fieldset("disabled" in attributes))
        elif tag == "legend" and self._fieldsets:
            self._fieldsets[-1].legend_begins()
        elif tag == "input":
            kind = attributes.get("type", "text").lower()
            self._add(Control(kind if kind in _TYPES else "text", attributes))
        elif tag == "button":
            kind = attributes.get("type", "submit").lower()
            self._add(Control(kind if kind in _NEVER_SENT else "submit", attributes))
        elif tag == "textarea":
            self._add(Control("textarea", attributes, text=html.unescape(token.content).removeprefix("\n")))
        elif tag == "select":
            self._select = Control("select", attributes)
            self._add(self._select)
        elif tag == "optgroup":
            self._end_option()
            self._group_disabled = "disabled" in attributes
        elif tag == "option" and self._select is not None:
            self._end_option()
            self._option, self._label = attributes, []
        elif self._form is not None:
            shows = tag == "style" and _SHOWING_STYLE.search(token.content) is not None
            self._form.may_change |= shows or tag in ("script", "link")
        if tag in markup.VOID or tag in markup.RAW:
            self._open.pop()

    def end(self, tag: str) -> None:
        names = [name for name, _ in self._open]
        if tag in names:
            del self._open[len(names) - 1 - names[::-1].index(tag) :]
        if tag == "form":
            self._form = None
        elif tag == "fieldset" and self._fieldsets:
            self._fieldsets.pop()
        elif tag == "legend" and self._fieldsets:
            self._fieldsets[-1].in_legend = False
        elif tag == "option":
            self._end_option()
        elif tag == "optgroup":
            self._end_option()
            self._group_disabled = False
        elif tag == "select":
            self._end_option()
            self._select, self._group_disabled = None, False

    def text(self, text: str) -> None:
        if self._option is not None:
            self._label.append(html.unescape(text))

    def all_forms(self) -> list[Form]:
        """Return the forms, once the page is read."""
        for form_id, control in self._by_form_id:
            if form_id in self._by_id:
                self._by_id[form_id].controls.append(control)
        return self._forms

    def _add(self, control: Control) -> None:
        if "disabled" in control.attributes or any(fieldset.disables for fieldset in self._fieldsets):
            return
        if control.kind in _NEVER_SENT or any(name in _INERT for name, _ in self._open):
            return
        control.hidden = any(hidden for _, hidden in self._open)
        if "form" in control.attributes:
            self._by_form_id.append((control.attributes["form"], control))
        elif self._form is not None:
            self._form.controls.append(control)

    def _end_option(self) -> None:
        if self._select is not None and self._option is not None:
            attributes = self._option
            text = " ".join("".join(self._label).split())
            disabled = "disabled" in attributes or self._group_disabled
            self._select.options.append(SelectOption(attributes.get("value", text), "selected" in attributes, disabled))
        self._option = None


def _is_hidden(tag: str, attributes: Mapping[str, str]) -> bool:
    """Whether an element's own tag hides it, with all that is in it."""
    closed = tag == "dialog" and "open" not in attributes
    styled = _HIDING_STYLE.search(attributes.get("style", "")) is not None
    return closed or styled or "hidden" in attributes or "inert" in attributes


@dataclass
class _Fieldset:
    """An open fieldset. If it is disabled, so are its controls, except for controls in its first legend."""

    disabled: bool
    legends: int = 0
    in_legend: bool = False

    def legend_begins(self) -> None:
        self.legends += 1
        self.in_legend = self.legends == 1

    @property
    def disables(self) -> bool:
        return self.disabled and not self.in_legend
