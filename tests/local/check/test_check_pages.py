"""`hippodrome check` on pages: Jinja, HTML, questions, and the code that recruiters ask for."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import pytest

from hippodrome.control.config import ConfigErrors, read_project
from hippodrome.local.check.pages import check_pages
from tests.local.check.checking import config, looked, page

# --- Jinja -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\n{% if group %}", "2: Jinja cannot read this: Unexpected end of template."),
        ("a\n{% endfi %}", "2: Jinja cannot read this: Encountered unknown tag 'endfi'."),
        ("\n\n{{ group|shout }}", "3: there is no filter shout in Jinja"),
        ("{{ group|uper }}", "1: there is no filter uper in Jinja; did you mean upper?"),
        ("\n{% if answers['1'].a %}\n{{ group|uper }}{% endif %}", "3: there is no filter uper"),
        ("{% if group is evn %}{% endif %}", "1: there is no test evn in Jinja; did you mean even?"),
        ("<title>x\n</title>\n{{ nobody() }}", "3: the page cannot be shown: UndefinedError: 'nobody' is undefined"),
        ("\n{% include 'other.html' %}", "2: include, import and extends do not work: a page is one file"),
        (
            "<style>@media print{#menu{display:none}}</style>{{ group }}",
            "1: Jinja cannot read this: Missing end of comment tag; {# begins",
        ),
        ("{{ 1 // 0 }}", "1: the page cannot be shown: ZeroDivisionError"),
        ("{{ 'x' * 2000001 }}", " the page cannot be shown: the page is larger than 2 MB with its values filled in"),
    ],
)
def test_mistakes_in_jinja_are_reported(folder: Path, text: str, said: str) -> None:
    page(folder, text)
    assert any(line.startswith(f"steps/hello.html:{said}") for line in looked(folder)), looked(folder)
    assert any(not problem.remark for problem in check_pages(folder, read_project(folder)))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "{% if group == 0 %}a{% else %}b{% endif %}",
            "the study has no groups, so all participants see the same branch; ",
        ),
        ("{{ completion_cod }}", "nothing is shown: there is no value completion_cod; did you mean completion_code?"),
        ("{{ answers['1'].n * 2 }}", "a participant without the answer gets an error page here (UndefinedError: "),
    ],
)
def test_jinja_that_may_be_intended_is_remarked(folder: Path, text: str, said: str) -> None:
    page(folder, text)
    (line,) = looked(folder)
    assert line.startswith(f"steps/hello.html:1: remark: {said}")


def test_good_jinja_gets_no_finding(folder: Path) -> None:
    page(
        folder,
        """{{ answers["3"].x.y }} {{ participant.PROLIFIC_PID }} {{ project.name|upper }} {{ completion_code }}
        {% set n = 3 %}{{ n }} {% for i in range(3) %}<input name="q{{ i }}">{% endfor %} {{ answers["1"].a|tojson }}
        <style>@media print{ #menu{display:none}}</style> {{ group if group is not none else "nobody" }}""",
    )
    assert looked(folder) == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{{ answers["1"].aeg }}', "step 1 has no answer aeg; did you mean age? (it has age, pets, go)"),
        ("{{ answers['1']['mood'].x }}", "step 1 has no answer mood (it has age, pets, go)"),
        ('{{ answers["2"].points }}', "step 2 has no answer points (it has episodes, score, "),
        ("{% if answers[1].age %}{% endif %}", 'write answers["1"], with quotes'),
        ('{{ answers["1"].items }}', "step 1 has no answer items (it has age, pets, go)"),
        ("{{ answers.hello.age }}", 'answers have the keys of steps: write answers["1"] for the page hello'),
        ('{{ answers["bye"]["x"] }}', 'answers have the keys of steps: write answers["3"] for the page bye'),
        ("{{ answers['9'].x.y }}", "there is no step 9"),
    ],
)
def test_answers_that_cannot_exist_are_reported(folder: Path, text: str, said: str) -> None:
    page(folder, ASKS)
    page(folder, f"\n{text}", "bye")
    (line,) = looked(folder)
    assert line.startswith(f"steps/bye.html:2: remark: nothing is shown: {said}")


ASKS = """<label>Age <input type="number" name="age"></label><textarea name="pets" aria-label="pets"></textarea>
<button name="go" value="1">Go</button>"""


def test_answers_that_may_exist_get_no_finding(folder: Path) -> None:
    page(folder, ASKS)
    page(
        folder,
        """{{ answers["1"].age }} {{ answers["1"]["pets"] }} {{ answers["1"].go }} {{ answers["1"].items() }}
        {{ answers["2"].score }} {{ answers["2"].scores.red }} {{ answers["3"].own }} {{ answers[group] }}""",
        "bye",
    )
    assert looked(folder) == []
    for made in ("<script>document.title = 1</script>", '<input name="q{{ group }}" aria-label="q">'):
        page(folder, ASKS + made)
        page(folder, '{{ answers["1"].made }}', "bye")
        assert looked(folder) == [], "its fields are not all known"


def test_each_group_is_shown_its_page(folder: Path) -> None:
    (folder / "steps" / "hello.html").unlink()
    page(folder, "{{ 1 // group }}", "hello-0")
    page(folder, "{{ 1 // group }}", "hello-1")
    page(folder, "\n{% if group == 1 %}{{ 1 // 0 }}{% endif %}", "bye")
    lines = looked(folder)
    assert [line.partition(": ")[0] for line in lines] == ["steps/hello-0.html:1", "steps/bye.html:2"]


def test_crossed_versions_are_shown_with_each_version_of_the_earlier_page(folder: Path) -> None:
    for old in ("hello", "bye"):
        (folder / "steps" / f"{old}.html").unlink()
    page(folder, "<input name=word aria-label=word>", "hello-0")
    page(folder, "<p>Hello</p>", "hello-1")
    for version in range(3):
        page(folder, '{{ answers["1"].word + "!" }}' if version == 2 else "<p>Bye</p>", f"bye-{version}")
    (line,) = looked(folder)
    assert line.startswith("steps/bye-2.html:1: ")
    page(folder, '{{ answers["1"].word | default("") }}', "bye-2")
    assert looked(folder) == []


# --- HTML --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<img src='cta.png'>", "there is no cta.png in steps/; did you mean cat.png?"),
        ("<img src='Cat.png'>", "there is no Cat.png in steps/; did you mean cat.png?"),
        (
            "<img src='pictures/cat.png'>",
            "pictures/cat.png is not found: put the file into steps/ itself and write cat.png",
        ),
        ("<img src='/steps/quick/dog.png'>", "there is no dog.png in steps/"),
        ("<img srcset='cat.png 1x, dog.png 2x'>", "there is no dog.png in steps/"),
        ("<video poster=dog.png></video>", "there is no dog.png in steps/"),
        ("<img src='cat.bmp'>", "cat.bmp is not shown: of files beside the pages only png, "),
        ("<iframe src='bye.html'></iframe>", "<iframe> cannot show a file of the project"),
        ("<p onclick='go()'>", "onclick never runs; use addEventListener in a <script> of the page"),
        ("<a href='javascript:go()'>x</a>", "javascript: never runs; "),
        ("<textarea></textarea>", "this <textarea> has no name"),
        ("<select name=''></select>", "this <select> has no name"),
        ("<a href='sheet.pdf'>x</a>", "there is no sheet.pdf in steps/"),
        ("<a href='/steps/quick/sheet.pdf'>x</a>", "there is no sheet.pdf in steps/"),
        ("<map><area href='ct.png'></map>", "there is no ct.png in steps/; did you mean cat.png?"),
        ("<a href='files/cat.png'>x</a>", "files/cat.png is not found: put the file into steps/ itself"),
        ("<img src='{{ project.id }}.png'>", "a file's name that begins with a value is not found; "),
        (
            "<a href='{{ project.id }}.pdf'>x</a>",
            "a file's name that begins with a value is not found; write ./ before",
        ),
        (
            r"<img src='C:\Users\me\dog.png'>",
            r"participants do not have C:\Users\me\dog.png: put the file into steps/ and",
        ),
        ("<a href='file:///home/me/a.pdf'>x</a>", "participants do not have file:///home/me/a.pdf: put the file into"),
        ("<a href='cat.zip'>x</a>", "cat.zip is not shown: of files beside the pages only png, "),
        ("<a href='bye.html#end'>x</a>", "bye.html cannot be opened by a link; make it a step, or link to a PDF"),
        ("<a href='www.example.org/x'>x</a>", "www.example.org/x is not found; write https:// before it"),
        ("<meta http-equiv=Refresh content='0;url=https://a.example'>", '<meta http-equiv="refresh"> does nothing; '),
        ("<base href='https://a.example/'>", "<base> does nothing; write the whole address in each tag"),
        ("<form action='https://a.example/'></form>", "the answers are stored as those of this study, and are not"),
        ("<p style='background: url(cat.png)'>", "cat.png is not found from a style; write url(/steps/quick/cat.png)"),
        ("<style>p { background: url('cat.png') }</style>", "cat.png is not found from a style; "),
    ],
)
def test_doubtful_html_is_remarked(folder: Path, text: str, said: str) -> None:
    (folder / "steps" / "cat.png").touch()
    page(folder, f"{{# a\ncomment #}}\n{text}")
    (line,) = looked(folder)
    assert line.startswith(f"steps/hello.html:3: remark: {said}")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<input type=File name=x>", "files cannot be sent; take this field out"),
        (
            "<img src='https://other.example/cat.png'>",
            "https://other.example is not in allowedHosts of the config file, so nothing is loaded; "
            "add https://other.example to allowedHosts",
        ),
        ("<script src='//other.example/x.js'></script>", "https://other.example is not in allowedHosts"),
        (
            "<img src='http://media.example/cat.png'>",
            "http://media.example is not in allowedHosts of the config file, so nothing is loaded; write https:// here",
        ),
        ("<link rel=stylesheet href=https://media.example/x.css>", "style sheets of other places are not loaded"),
        ("<embed src=https://media.example/x>", "<embed> is never shown"),
        ("<iframe src='https://q.example/f?PID={{ participant.userId }}'></iframe>", "https://q.example is not in "),
        ("<iframe src='//q.example/{{ group }}'></iframe>", "https://q.example is not in allowedHosts"),
        ("<img src='https://q.example/{{ group }}.png'>", "https://q.example is not in allowedHosts"),
        ("<img srcset='cat-{{ group }}.png 1x, https://q.example/{{ group }} 2x'>", "https://q.example is not in"),
        ("<video src='https://q.example#{{ group }}'></video>", "https://q.example is not in allowedHosts"),
        ("<script src='https://q.example/x.js?{{ group }}'></script>", "https://q.example is not in allowedHosts"),
        ("<link rel=stylesheet href='https://media.example/{{ group }}.css'>", "style sheets of other places are not"),
        ("<object data='https://q.example/{{ group }}'></object>", "<object> is never shown"),
        ("<script src='x-{{ group }}.js'></script>", "a script of the project whose address holds a value never runs"),
        ("<script src='{{ group }}.js'></script>", "a script of the project whose address holds a value never runs"),
        ("<button formaction='https://q.example/?{{ group }}'>x</button>", "a form is never sent to another site"),
    ],
)
def test_mistakes_in_html_are_reported(folder: Path, text: str, said: str) -> None:
    config(folder, "  maxRuntime", "  allowedHosts: [https://media.example]\n  maxRuntime")
    page(folder, f"\n{text}")
    (line,) = looked(folder)
    assert line.startswith(f"steps/hello.html:2: {said}")


@pytest.mark.parametrize("size", [4 * 1024**2, 4 * 1024**2 + 1])
def test_a_file_that_aws_does_not_serve_is_a_mistake(on_aws: Path, size: int) -> None:
    (on_aws / "steps" / "sheet.pdf").write_bytes(b"x" * size)
    lines = [line for line in looked(on_aws) if "sheet.pdf" in line]
    too_large = (
        "steps/sheet.pdf: larger than 4 MB, which AWS does not serve; make it smaller, or put it on another site"
    )
    assert lines == ([too_large] if size > 4 * 1024**2 else [])


def test_a_file_from_a_mac_is_there(folder: Path) -> None:
    (folder / "steps" / unicodedata.normalize("NFD", "Übung.png")).touch()
    page(
        folder,
        f"<img src='Übung.png'><img src='{unicodedata.normalize('NFD', 'Übung.png')}'><a href='%C3%9Cbung.png'>x</a>",
    )
    assert looked(folder) == []


def test_comments_end_where_browsers_end_them(folder: Path) -> None:
    page(folder, '<![1]>\n<![if !mso]><p onclick="x()">a</p><![endif]>')
    (line,) = looked(folder)
    assert line.startswith("steps/hello.html:2: remark: onclick never runs")


def test_good_html_gets_no_finding(folder: Path) -> None:
    config(folder, "  maxRuntime", "  allowedHosts: [https://media.example]\n  maxRuntime")
    (folder / "steps" / "a cat.png").touch()
    (folder / "steps" / "x.js").touch()
    page(
        folder,
        """<img src="a%20cat.png?2#x"><img src="./a cat.png"><img src="/steps/quick/a%20cat.png">
        <img src="https://MEDIA.example/x.png"><img src="https://media.example:443/x"><img src="data:image/png;base64,AA=">
        <img src="./{{ project.id }}.png"><a href="https://anywhere.example">x</a><link rel="preconnect" href="https://x.example">
        <iframe src="https://media.example/video"></iframe><script src="x.js"></script>
        <script>if (1 < 2) document.write('<img src="none.png" onclick="x">')</script>
        <input type="submit"><input type=button><button>Go</button><input name="q{{ group }}" value="{{ answers["1"].n }}">
        <!-- <img src="none.png"> --> <style>p { background: url(/steps/quick/x.png), url(data:image/png;base64,AA=) }</style>
        <iframe src="https://media.example/{{ group }}"></iframe><img src="https://{{ group }}.example/x.png">
        <img src="https://media.example{{ group }}/x.png"><img src="cat-{{ group }}.png"><script src="x.js?{{ group }}"></script>
        <a href="a%20cat.png">x</a><a href="#part">x</a><a href="?userId=x">x</a><a href="next?projectId=x">x</a><a href="/">x</a>
        <a href="mailto:a@b.example">x</a><a href="{{ answers["1"].link }}">x</a><a href="sheet-{{ group }}.pdf">x</a>
        <meta name="viewport" content="width=device-width"><p one="x" only="y">""",
    )
    assert looked(folder) == []


# --- questions and tags ------------------------------------------------------------------------------


def radio(name: str, *values: str) -> str:
    return "\n".join(f'<label><input type="radio" name="{name}" value="{value}"> {value}</label>' for value in values)


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (radio("q", "a", "b") + "\n" + radio("q", "a", "b"), 4, "an earlier question has the name q too"),
        (f"<fieldset>{radio('q', 'a', 'b')}</fieldset>\n<fieldset>{radio('q', 'c', 'd')}</fieldset>", 4, "an earlier question has"),
        (f"<table><tr><td>{radio('q', '1', '2')}</tr>\n<tr><td>{radio('q', '3', '4')}</tr></table>", 4, "an earlier question has"),
        ('<input type="radio" name="q" value="a">\n<input type="radio" name="q">', 3, "this choice of q has no value"),
        ("a\n<textarea name=x>\n<p>more", 3, "<textarea> is never closed, so the rest of the page is not shown"),
        ("<script>let a = 1", 2, "<script> is never closed"),
        ("<script src='https://media.example/x.js'/>\n<p>", 2, "<script> is never closed, so the rest of the page is not shown"),
        ("a\n<!-- a comment\n<p>", 3, "this comment is never closed"),
        ("<script>\nconst a = '{{ answers['1'].a }}'\n</script>", 3, "in a <script>, write {{ answers['1'].a|tojson }}"),
        ("<script>var id = {{ participant.PROLIFIC_PID }};</script>", 2, "in a <script>, write {{ participant.PROLIFIC_PID|tojson }}"),
    ],
)  # fmt: skip
def test_questions_and_tags_that_lose_something_are_mistakes(folder: Path, text: str, line: int, said: str) -> None:
    page(folder, f"<h1>Hello</h1>\n{text}")
    found = looked(folder)
    assert any(each.startswith(f"steps/hello.html:{line}: {said}") for each in found), found


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("a\n<div>b", 3, "<div> is never closed; add </div>"),
        ("<b>a\n<i>b</b>", 3, "<i> is never closed"),
        ("a\n</section>", 3, "</section> closes nothing"),
    ],
)
def test_tags_left_open_are_remarks(folder: Path, text: str, line: int, said: str) -> None:
    page(folder, f"<h1>Hello</h1>\n{text}")
    assert [each for each in looked(folder) if each.startswith(f"steps/hello.html:{line}: remark: {said}")]


def test_good_questions_and_tags_get_no_finding(folder: Path) -> None:
    page(
        folder,
        f"""<h1>Hello<br></h1><p>One<p>Two<ul><li>a<li>b</ul>
        <fieldset>{radio("q", "a", "b")}</fieldset><fieldset>{radio("r", "a", "b")}</fieldset>
        <table><tr><td>{radio("s", "1")}</td></tr><tr><td>{radio("s", "2")}</td></tr><tr><td>{radio("s", "3")}</table>
        {{% if completion_code %}}{radio("t", "a", "b")}{{% else %}}{radio("t", "a", "b")}{{% endif %}}
        {{% for i in range(2) %}}<div>{radio("u{{ i }}", "a", "b")}</div>{{% endfor %}}
        <svg><path d="M0 0"/><circle r="1"/></svg> <b><i>x</b></i>
        <script>const a = {{{{ answers["1"].a|tojson }}}}, g = {{{{ group }}}}, n = {{{{ (group or 0)|int }}}}; if (a < 1) b = "<div>"</script>""",
    )  # fmt: skip
    assert looked(folder) == []


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (radio("q", "a", "b"), '<input type="range" name="q">'),
        ('<input type="range" name="q">\n', radio("q", "a", "b")),
        (radio("q", "a", "b"), '<textarea name="q"></textarea>'),
        (radio("q", "a", "b"), '<select name="q"><option>1</option></select>'),
        (radio("q", "a", "b"), '<input name="q">'),
        ('<input name="q">\n', '<input name="q">'),
        ('<input type="number" name="q">\n', '<select name="q"><option>1</option></select>'),
        ('<input type="checkbox" name="q" value="a">\n', '<input type="range" name="q">'),
    ],
)
def test_two_fields_of_the_same_name_are_remarked(folder: Path, first: str, second: str) -> None:
    page(folder, f"<h1>Hello</h1>\n{first}\n{second}")
    said = "steps/hello.html:4: remark: an earlier question has the name q too, so both answers are stored under it, "
    assert looked(folder) == [f"{said}as a list; give each a name of its own"]


@pytest.mark.parametrize(
    "text",
    [
        radio("q", "a", "b") + '<input type="range" name="r"><button name="q" value="c">Go</button>',
        "{% if group %}" + radio("q", "a", "b") + '{% else %}<input type="range" name="q">{% endif %}',
        '{% for i in range(2) %}<input type="radio" name="q{{ i }}" value="a">{% endfor %}<input name="q{{ group }}">',
        '<input type="checkbox" name="q" value="a"><input type="checkbox" name="q" value="b">',
        '<input type="hidden" name="q" value="no"><input type="checkbox" name="q" value="yes">',
        '<input name=""><input type="radio" name="" value="a">',
    ],
)
def test_radio_buttons_beside_fields_of_other_names_get_no_remark(folder: Path, text: str) -> None:
    page(folder, text)
    assert not [line for line in looked(folder) if "an earlier question" in line]


def test_fields_without_a_name_are_one_remark_for_each_page(folder: Path) -> None:
    page(folder, "<input>\n<textarea></textarea><select></select>\n<input name='x'>\n<input type=radio value=a>")
    assert looked(folder) == [
        "steps/hello.html:1: remark: 4 fields have no name, so what is entered there is never sent: lines 1, 2 and 4"
    ]
    page(folder, "<input>\n<input>", "bye")
    assert len(looked(folder)) == 2
    page(folder, "\n<input><input>", "bye")
    assert looked(folder)[1] == (
        "steps/bye.html:2: remark: 2 fields have no name, so what is entered there is never sent: line 2"
    )


def test_earlier_answers_are_available_to_pages(folder: Path) -> None:
    page(
        folder,
        '<input type="number" name="age" required><input type="number" name="more"><input type="radio" name="r" value="1">',
    )
    page(
        folder,
        '{% if answers["1"].age|int > 1 %}{{ answers["1"].age * 2 }}{% endif %}{{ answers["2"].score + 1 }}',
        "bye",
    )
    assert looked(folder) == []
    page(folder, '\n{{ answers["1"].r + "x" }}{{ answers["1"].r.strip() }}', "bye")
    (line,) = looked(folder)
    assert line.startswith("steps/bye.html:2: remark: a participant without the answer gets an error page here")
    page(folder, '{{ answers["3"].word.strip() }}', "bye")  # its own answer
    assert "remark: a participant without the answer gets" in looked(folder)[0]


def test_a_page_without_a_step_is_remarked(folder: Path) -> None:
    page(folder, "<p>Hi</p>", "forgotten")
    assert looked(folder) == [
        "steps/forgotten.html: remark: no step shows this page; name it under project.steps, or delete it"
    ]


def test_the_page_of_an_end_belongs_to_the_study_and_knows_the_answers_before_it(folder: Path) -> None:
    config = 'project:\n  id: p\n  steps: [consent, debrief]\n  ends:\n    declined: {when: answers.consent.agree == "no", page: sorry}\n'
    (folder / "config.yml").write_text(config, encoding="utf-8")
    page(folder, '<button name="agree" value="no">No</button>', "consent")
    page(folder, "<p>{{ completion_code }}</p>", "debrief")
    page(folder, "<p>{{ answers.consent.agree }}{{ answers.consent.agreed }}</p>", "sorry")
    (line,) = [line for line in looked(folder) if "sorry" in line]
    assert "step consent has no answer agreed; did you mean agree?" in line


def test_the_right_answer_of_a_check_is_one_of_the_choices(folder: Path) -> None:
    config = "project:\n  id: p\n  steps:\n    - quiz: {right: {side: middle, sure: yes}}\n    - debrief\n"
    (folder / "config.yml").write_text(config, encoding="utf-8")
    sides = '<select name="side"><option value="">?</option><option>Left</option><option>Right</option></select>'
    page(folder, f'{sides}<input type="radio" name="sure" value="Yes">', "quiz")
    page(folder, "<p>{{ completion_code }}</p>", "debrief")
    (line,) = [line for line in looked(folder) if "offers" in line]
    assert line.endswith("quiz.right.side: quiz.html offers no middle for side; it has Left, Right")


@pytest.mark.parametrize(
    "rule", ['answers.consent.agree == "No"', '"No" != answers.consent.agree', 'answers.consent.agree in ["No", "no"]']
)
def test_a_text_in_a_rule_that_no_choice_has_is_remarked(folder: Path, rule: str) -> None:
    config = f"project:\n  id: p\n  steps: [consent, debrief]\n  ends: {{declined: '{rule}'}}\n"
    (folder / "config.yml").write_text(config, encoding="utf-8")
    page(folder, '<input type="radio" name="agree" value="yes"><input type="radio" name="agree" value="no">', "consent")
    page(folder, "<p>{{ completion_code }}</p>", "debrief")
    (line,) = [line for line in looked(folder) if "offers" in line]
    assert line.endswith("project.ends.declined: consent offers no No for agree; it has yes, no")


def test_the_page_of_an_end_must_be_there(folder: Path) -> None:
    config = "project:\n  id: p\n  steps: [consent, debrief]\n  ends:\n    late: {minutes: 9, page: sory}\n"
    (folder / "config.yml").write_text(config, encoding="utf-8")
    for name in ("consent", "debrief", "sorry"):
        page(folder, "<p>{{ completion_code }}</p>", name)
    with pytest.raises(ConfigErrors, match=r"ends\.late\.page: there is no sory\.html in steps/; did you mean sorry\?"):
        looked(folder)


def test_several_pages_without_a_step_are_one_remark(folder: Path) -> None:
    for name in ("left", "forgotten"):
        page(folder, "<p>Hi</p>", name)
    assert looked(folder) == [
        "steps/: remark: no step shows these pages; name them under project.steps, or delete them: "
        "forgotten.html, left.html"
    ]


@pytest.mark.parametrize("text", ["<" * 5000, "<!", "<![x", "{{", "<img src='http://[x'>", "\0<p\0>", "<p " * 999])
def test_no_page_makes_the_check_crash(folder: Path, text: str) -> None:
    page(folder, text)
    page(folder, "{{ answers['1'].word }}", "bye")
    looked(folder)


# --- a button to go on with ----------------------------------------------------------------------------

NOBODY = (
    "steps/hello.html: the page has no button that can be pressed, so nobody can go on; show its button, or take it "
    "out: then the page has the button Continue"
)
SCREENS = (
    '<select name="pet"><option>cat<option>dog</select><input type="radio" name="ok" value="no"><input name="word">'
    '<input type="number" name="age" min="1">'
)


@pytest.mark.parametrize(
    "text",
    [
        "<button hidden>Go</button>",
        "<div style='display:none'><input type=submit></div>",
        "{% if group is none %}<button disabled>Go</button>{% endif %}",
        "{% if group is none %}<fieldset disabled>{% endif %}",
    ],
)
def test_a_page_that_nobody_can_send_is_a_mistake(folder: Path, text: str) -> None:
    page(folder, text)
    assert NOBODY in looked(folder)


@pytest.mark.parametrize(
    "text",
    [
        "<button hidden>Go</button><script>setTimeout(show, 1000)</script>",
        "{% if group %}<button>Go</button>{% endif %}",
        "<button hidden>Go</button><button>Go</button>",
        "<button type=button hidden>Play</button>",
    ],
)
def test_a_page_with_a_button_or_a_script_that_may_show_it_gets_no_finding(folder: Path, text: str) -> None:
    page(folder, text)
    assert looked(folder) == []


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("answers['1'].pet == 'dog'", 'pet = "dog" at step 1'),
        ("answers['1'].pet != 'dog'", 'pet = "cat" at step 1'),
        ("answers['1'].ok == 'no'", 'ok = "no" at step 1'),
        ("answers['1']['word']|lower == 'blue'", 'word = "blue" at step 1'),
        ("answers['1'].age|int < 18", 'age = "17" at step 1'),
        ("answers['2'].score > 100", "score = 101 at step 2"),
        ("answers['2'].outcome == 'failed'", 'outcome = "failed" at step 2'),
    ],
)
def test_answers_after_which_nobody_can_go_on_are_remarked(folder: Path, condition: str, said: str) -> None:
    page(folder, SCREENS)
    page(folder, f"{{% if {condition} %}}<button hidden>x</button>{{% else %}}<h1>You are in</h1>{{% endif %}}", "bye")
    assert looked(folder) == [
        f"steps/bye.html: remark: with {said} the page has no button that can be pressed, so these participants end here"
    ]


def test_the_last_page_needs_a_button_only_if_it_asks_something(folder: Path) -> None:
    page(folder, "{{ completion_code }}<button hidden>x</button>", "end")
    assert looked(folder) == []
    page(folder, "{{ completion_code }}<input name=a><button hidden>x</button>", "end")
    assert [line.partition(":")[2] for line in looked(folder)] == [NOBODY.partition(":")[2]]


def test_an_answer_with_which_a_page_fails_is_named(folder: Path) -> None:
    page(folder, SCREENS)
    page(folder, "{% if answers['1'].pet == 'cat' %}{{ 1 // 0 }}{% else %}{{ 1 }}{% endif %}", "bye")
    (line,) = looked(folder)
    assert line.startswith("steps/bye.html:1: remark: a participant ")
    assert "ZeroDivisionError" in line


def test_what_is_wrong_in_a_page_that_hippo_shows_is_a_remark(folder: Path) -> None:
    (folder / "steps").rename(folder / "StepFiles")
    question = '<fieldset><input type="radio" name="q" value="a"><input type="radio" name="q" value="b"></fieldset>'
    (folder / "StepFiles" / "hello.html").write_text(f"{question}{question}")
    (problem,) = check_pages(folder, read_project(folder))
    assert problem.remark
    assert "an earlier question has the name q too" in problem.message


# --- the code that recruiters ask for -----------------------------------------------------------------

NO_CODE = (
    "remark: this last page shows no completion code and no link: those who come from a recruiting site need one; "
    "write {{ completion_code }}, or a link back to the site"
)


def of_codes(folder: Path, name: str = "end") -> list[str]:
    return [line.removeprefix(f"steps/{name}.html: ") for line in looked(folder) if "completion_code" in line]


@pytest.fixture
def on_aws(folder: Path) -> Path:
    config(folder, "  maxRuntime: 5", "  maxRuntime: 5\n  useAWS: true\n  awsSetup: {cpu: 1, memory: 2}")
    return folder


@pytest.fixture
def no_code(folder: Path) -> Path:
    page(folder, "<h1>end</h1>", "end")
    return folder


def test_a_last_page_without_a_code_is_remarked(no_code: Path) -> None:
    assert of_codes(no_code) == [NO_CODE]
    page(no_code, "{{ completion_code }}", "hello")
    assert of_codes(no_code) == [NO_CODE], "those who do not finish see the earlier pages, too"


@pytest.mark.parametrize(
    "text",
    [
        "{# {{ completion_code }} #}",
        "<p>Your completion_code</p>",
        "{% raw %}{{ completion_code }}{% endraw %}",
        "<!-- <a href='https://recruiter.example/complete?cc=C1'>back</a> -->",
        "<a href='more.html'>more</a>",
    ],
)
def test_pages_without_a_visible_code_are_remarked(no_code: Path, text: str) -> None:
    page(no_code, text, "end")
    assert of_codes(no_code) == [NO_CODE]


@pytest.mark.parametrize(
    "text",
    [
        "<p>Your code: {{ completion_code }}</p>",
        "{% if group %}{{ completion_code|lower }}{% endif %}",
        "<p><a href='https://recruiter.example/submissions/complete?cc=YOURCODE'>Return</a></p>",
        '<a href="https://recruiter.example/?id={{ participant.userId }}">Return</a>',
        '<p class="code">C1A2B3</p>',
        '<script>location.href = "https://recruiter.example/complete?cc=C1"</script>',
    ],
)
def test_a_code_or_a_link_back_gets_no_remark(no_code: Path, text: str) -> None:
    page(no_code, text, "end")
    assert of_codes(no_code) == []


def test_each_groups_last_page_needs_one(no_code: Path) -> None:
    (no_code / "steps" / "end.html").unlink()
    page(no_code, "{{ completion_code }}", "end-0")
    page(no_code, "<h1>Goodbye</h1>", "end-1")
    assert of_codes(no_code, "end-1") == [NO_CODE]


@pytest.mark.parametrize("key", ["useAWS: false", "signedLinks: true"])
def test_a_study_that_no_recruiting_site_sends_people_to_needs_no_code(no_code: Path, key: str) -> None:
    config(no_code, "  maxRuntime: 5", f"  maxRuntime: 5\n  {key}")
    assert of_codes(no_code) == []
