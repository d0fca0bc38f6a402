"""The forms of a page, read as a browser reads them. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from hippodrome.participants.page_parser import PageParser, attributes_of

PRESSED = ("submit", "image")
"""Types of the buttons that send a form."""
_NEVER_SENT = ("reset", "button")
"""Types of the buttons that send nothing."""
_TIMES = ("date", "time", "datetime-local", "month", "week")
_TEXTS = ("text", "search", "password", "email", "url", "tel")
_TYPES = {*_TEXTS, *_TIMES, *PRESSED, *_NEVER_SENT, "color", "number", "range", "hidden", "radio", "checkbox", "file"}
"""Types of inputs. A browser takes any other type for `text`."""


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

    @property
    def buttons(self) -> list[Control]:
        return [control for control in self.controls if control.kind in PRESSED]


def read(page: str) -> list[Form]:
    """Return the forms of a page in their order."""
    reader = _Reader()
    reader.feed(page)
    reader.close()
    return reader.forms


def to_answer(page: str) -> Form | None:
    """Return the first form of a page that is sent by POST; None if the page has no such form."""
    return next((form for form in read(page) if form.method == "post"), None)


def hidden(form: Form) -> Iterator[tuple[str, str]]:
    """Yield the name and the value of each hidden field of a form."""
    return ((control.name, control.value) for control in form.controls if control.kind == "hidden")


class _Reader(PageParser):
    """Gathers forms with their controls, as browsers do: it follows `form="…"` and disabled fieldsets."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.forms: list[Form] = []
        self._by_id: dict[str, Form] = {}
        self._form: Form | None = None
        self._by_form_id: list[tuple[str, Control]] = []  # controls that name their form by `form="…"`
        self._fieldsets: list[_Fieldset] = []
        self._select: Control | None = None
        self._option: dict[str, str] | None = None
        self._label: list[str] = []  # the text of the open option
        self._group_disabled = False
        self._textarea: Control | None = None

    def handle_starttag(self, tag: str, attrs: Iterable[tuple[str, str | None]]) -> None:
        attributes = attributes_of(attrs)
        if tag == "form" and self._form is None:
            self._form = Form(attributes.get("action", ""), attributes.get("method", "get").lower())
            self.forms.append(self._form)
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
            self._textarea = Control("textarea", attributes)
            self._add(self._textarea)
        elif tag == "select":
            self._select = Control("select", attributes)
            self._add(self._select)
        elif tag == "optgroup":
            self._end_option()
            self._group_disabled = "disabled" in attributes
        elif tag == "option" and self._select is not None:
            self._end_option()
            self._option, self._label = attributes, []

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._form = None
        elif tag == "fieldset" and self._fieldsets:
            self._fieldsets.pop()
        elif tag == "legend" and self._fieldsets:
            self._fieldsets[-1].in_legend = False
        elif tag == "textarea" and self._textarea is not None:
            self._textarea.text = self._textarea.text.removeprefix("\n")
            self._textarea = None
        elif tag == "option":
            self._end_option()
        elif tag == "optgroup":
            self._end_option()
            self._group_disabled = False
        elif tag == "select":
            self._end_option()
            self._select, self._group_disabled = None, False

    def handle_data(self, data: str) -> None:
        if self._textarea is not None:
            self._textarea.text += data
        elif self._option is not None:
            self._label.append(data)

    def close(self) -> None:
        super().close()
        for form_id, control in self._by_form_id:
            if form_id in self._by_id:
                self._by_id[form_id].controls.append(control)

    def _add(self, control: Control) -> None:
        if "disabled" in control.attributes or any(fieldset.disables for fieldset in self._fieldsets):
            return
        if control.kind in _NEVER_SENT:
            return
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
