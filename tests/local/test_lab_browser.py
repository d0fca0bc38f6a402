"""A phone in a lab: it opens the list of studies, takes part and plays, at this machine's address in its network."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hippodrome.local import lab
from testing.browser import NoChromium, chromium
from tests.local.conftest import Local

pytestmark = pytest.mark.browser
HERE = lab.host_of(lab.EVERYWHERE).shown


@pytest.mark.skipif(HERE.startswith("127."), reason="this machine is in no network")
def test_a_phone_opens_the_list_takes_part_and_plays_without_a_secure_context(local: Callable[..., Local]) -> None:
    one = local(frames=60)
    one.begin("--host", lab.EVERYWHERE)
    listed = one.wait_for_text(rf"(http://{HERE}:\d+/lab\?key=\w+)")[1]
    errors: list[str] = []
    try:
        with chromium() as browser:
            phone = browser.new_context(
                viewport={"width": 360, "height": 640}, has_touch=True, is_mobile=True
            ).new_page()
            phone.set_default_timeout(60_000)
            phone.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
            phone.goto(listed)
            assert phone.locator("svg").count() == 1
            assert phone.evaluate("document.documentElement.scrollWidth") <= 360
            phone.get_by_role("link").click()
            phone.wait_for_url("**/next?*signature=*")
            assert phone.evaluate("isSecureContext") is False, (
                "browsers offer a page over plain HTTP less than on loopback"
            )
            for page in ("hello", "bye"):
                phone.get_by_role("heading", name=page).wait_for()
                phone.locator("input[name=word]").fill("x")
                phone.get_by_role("button", name="Go on").tap()
                if page == "hello":
                    phone.locator("#overlay-button:visible").tap()
            phone.get_by_role("heading", name="end").wait_for()
            assert not phone.context.cookies()
    except NoChromium as missing:
        pytest.skip(str(missing))
    assert errors == []
    assert one.end() == 0
    (participant,) = (one.data / "quick" / "users").iterdir()
    assert sorted(path.name for path in (participant / "answers").iterdir()) == ["1.json", "2.json", "3.json"]
