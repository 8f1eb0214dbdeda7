"""The page in a real browser. With VOID_SCREENSHOTS=1 it also makes the pictures of docs/web.md."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright

from companion.config import Config
from companion.io.messages import Kind
from tests.companion.web.conftest import SETTINGS_TOML, Served
from tests.companion.web.showcase import FIRST, Looked, Showcase
from tests.companion.web.test_server import wait_until

PATIENCE_MS = 40_000
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
IMAGES = Path(__file__).parents[3] / "docs" / "images"
LAPTOP, PHONE = (1366, 900), (390, 844)

expect.set_options(timeout=PATIENCE_MS)

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here (scripts/setup-browser)"),
    pytest.mark.slow,
    pytest.mark.timeout(180),
]

Open = Callable[..., Page]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        # No sandbox: the tests may run as root, where Chromium has none, and it shows only our own page.
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        )
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Open]:
    """Open pages; at the end there must have been no error in any of them."""
    contexts: list[BrowserContext] = []
    faults: list[str] = []

    def open_one(served: Served, view: str = "live", size: tuple[int, int] = LAPTOP, **options: Any) -> Page:
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, **options)
        context.set_default_timeout(PATIENCE_MS)
        contexts.append(context)
        page = context.new_page()
        page.on(
            "console", lambda said: faults.append(said.text) if said.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("requestfailed", lambda request: faults.append(f"{request.url}: {request.failure}"))
        page.goto(f"{served.url}/#{view}")
        return page

    yield open_one
    for context in contexts:
        for page in context.pages:
            page.goto("about:blank")  # ends its socket before the server goes
        context.close()
    # What was asked for while the page was left is no fault of it.
    assert [fault for fault in faults if "ERR_ABORTED" not in fault] == []


def wait_for(page: Page, condition: str, arg: Any = None) -> None:
    """Wait until an expression of the page holds. Playwright's own way evaluates text in the page, which the page forbids."""
    deadline_s = time.monotonic() + PATIENCE_MS / 1000
    while not page.evaluate(condition, arg):
        assert time.monotonic() < deadline_s, condition
        page.wait_for_timeout(50)


def number_shown(page: Page) -> int:
    return int(page.locator("#picture").get_attribute("data-seq") or 0)


def wait_for_pictures(page: Page, count: int = 3) -> None:
    wait_for(page, "document.querySelector('#picture').dataset.seq > 0")
    first = number_shown(page)
    wait_for(page, f"document.querySelector('#picture').dataset.seq >= {first + count}")


def pixels(page: Page, canvas: str = "#picture") -> str:
    found: str = page.evaluate(f"document.querySelector('{canvas}').toDataURL()")
    return found


def shot(page: Page, name: str, *, full_page: bool = False) -> None:
    """Write a picture for the documentation, where that is asked for."""
    if os.environ.get("VOID_SCREENSHOTS") != "1":
        return
    page.evaluate("scrollTo(0, 0)")
    if page.locator("#view-live").is_visible():
        wait_for(page, "!document.querySelector('#picture').classList.contains('stale')")
    data = page.screenshot(full_page=full_page)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    cv2.imwrite(str(IMAGES / f"web-{name}.webp"), image, [cv2.IMWRITE_WEBP_QUALITY, 82])


def serious_faults(page: Page) -> list[str]:
    options = {
        "resultTypes": ["violations"],
        "runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"],
    }
    found = Axe().run(page, options=options).response["violations"]
    return [
        f"{fault['id']}: {node['target']} {node['failureSummary']}"
        for fault in found
        if fault["impact"] in ("serious", "critical")
        for node in fault["nodes"]
    ]


# ---------------------------------------------------------------------- live


def test_the_live_view_moves_and_says_what_it_shows(flying: Served, open_page: Open) -> None:
    page = open_page(flying)
    wait_for_pictures(page)
    expect(page.locator("#state-name")).to_have_text("STEER")
    expect(page.locator("#state-reason")).to_have_text("void 31 deg right of the goal")
    expect(page.locator("#connection-text")).to_have_text("live")
    expect(page.locator("#answer-words")).to_contain_text("gap, ")
    expect(page.locator("#links tr")).to_have_count(2)
    expect(page.locator("#state-list li")).to_have_count(6)
    expect(page.locator("#log")).to_contain_text("clock_refused")
    expect(page.locator("#plots b").first).to_contain_text("/s")
    expect(page).to_have_title("STEER · Void companion")
    before = pixels(page, "#map")
    page.get_by_role("button", name="Nearer").click()
    wait_for(page, "old => document.querySelector('#map').toDataURL() !== old", arg=before)


def test_layers_are_switched(serve: Callable[..., Served], looked: list[Looked], open_page: Open) -> None:
    served = serve()
    with Showcase(
        served.page, served.desk, looked[-1:]
    ):  # a picture that stands still: only layers change it
        page = open_page(served)
        wait_for_pictures(page)
        wait_for(page, "document.querySelector('#answer-words').textContent.startsWith('gap')")
        for name in ("Direction", "Void map", "Ranges"):
            box = page.get_by_role("checkbox", name=name)
            before = pixels(page)
            box.set_checked(not box.is_checked())
            wait_for(page, "old => document.querySelector('#picture').toDataURL() !== old", arg=before)
        expect(page.get_by_role("checkbox", name="Clusters")).to_be_hidden()
        assert Kind.DETAILS in served.desk.wants.kinds
        for name in ("Ranges", "Focus of expansion", "Void map"):
            page.get_by_role("checkbox", name=name).uncheck()
        page.evaluate(
            "for (const id of ['flow', 'clusters', 'lmcc', 'lines', 'candidates'])"
            " { const box = document.querySelector(`#layers input[value=${id}]`); if (box.checked) box.click(); }"
        )
        wait_until(lambda: Kind.DETAILS not in served.desk.wants.kinds)
        page.reload()
        wait_for_pictures(page)
        expect(page.get_by_role("checkbox", name="Void map")).not_to_be_checked()  # it is remembered


def test_the_papers_method_has_layers_of_its_own(
    serve: Callable[..., Served], looked_by_paper: list[Looked], open_page: Open
) -> None:
    served = serve()
    with Showcase(served.page, served.desk, looked_by_paper):
        page = open_page(served, color_scheme="light")
        wait_for_pictures(page)
        expect(page.get_by_role("checkbox", name="Ranges")).to_be_hidden()
        for name in (
            "Features",
            "Flow dropped",
            "Flow kept",
            "Clusters",
            "LMCC",
            "Lines",
            "Vanishing points",
        ):
            expect(page.get_by_role("checkbox", name=name)).to_be_visible()
        shot(page, "paper")


def test_a_server_that_goes_and_comes_back_is_found_again(
    flying: Served, open_page: Open, browser: Browser
) -> None:
    page = open_page(flying)
    wait_for_pictures(page)
    page.evaluate(
        "WebSocket.prototype.send = new Proxy(WebSocket.prototype.send, {apply(f, socket, said) {"
        " window.socket = socket; return f.apply(socket, said); }}); 0"
    )
    wait_for(page, "Boolean(window.socket)")
    page.evaluate("window.socket.close()")
    wait_for(page, "window.socket.readyState === WebSocket.CLOSED")
    wait_for_pictures(page)
    expect(page.locator("#connection-text")).to_have_text("live")


# ---------------------------------------------------------------------- settings


def test_a_setting_is_changed_undone_and_saved(flying: Served, open_page: Open) -> None:
    desk, default = flying.desk, Config().guidance.agree_deg
    page = open_page(flying, "settings")
    box = page.get_by_label("agree_deg")
    expect(box).to_have_value(f"{default:g}")
    box.fill("17.5")
    expect(page.locator("#settings-count")).to_contain_text("1 changed")
    page.get_by_role("button", name="Apply").click()
    expect(page.locator("#settings-note")).to_contain_text("guidance.agree_deg: acts now")
    assert desk.active.guidance.agree_deg == 17.5
    page.get_by_role("button", name="Undo agree_deg").click()
    expect(page.locator("#settings-note")).to_contain_text("as before")
    expect(box).to_have_value(f"{default:g}")
    assert desk.active.guidance.agree_deg == default

    page.locator("#set-guidance-max_step_m").fill("0.8")
    page.get_by_role("button", name="Apply").click()
    expect(page.locator("#settings-note")).to_contain_text("acts now")
    page.get_by_label("mount_pitch_deg").fill("5")
    page.get_by_role("button", name="Apply").click()
    expect(page.locator("#settings-note")).to_contain_text("the worker and the switch S are built on it")
    assert desk.active.camera.mount_pitch_deg == 4.0

    page.get_by_role("button", name="Compare and save").click()
    rows = page.locator("#compare-rows")
    expect(rows).to_contain_text("guidance.max_step_m")
    expect(rows).to_contain_text("camera.mount_pitch_deg")
    page.get_by_role("button", name="Show the change").click()
    expect(page.locator("#compare-diff")).to_contain_text("+max_step_m = 0.8  # careful indoors")
    shot(page, "compare")
    assert flying.settings_file.read_text() == SETTINGS_TOML
    wanted = ("guidance.max_step_m", "camera.mount_pitch_deg")
    for key in rows.locator("input:checked").evaluate_all("boxes => boxes.map((box) => box.value)"):
        rows.locator(f'input[value="{key}"]').set_checked(key in wanted)
    page.get_by_role("button", name="Save to the file").click()
    expect(page.locator("#compare-message")).to_contain_text("Saved")
    saved = flying.settings_file.read_text()
    assert saved == SETTINGS_TOML.replace("max_step_m = 1.2", "max_step_m = 0.8").replace("= 4.0", "= 5")
    page.get_by_role("button", name="Close").click()

    page.locator("#set-guidance-max_step_m").fill("-3")
    page.get_by_role("button", name="Apply").click()
    expect(page.locator("#settings-note")).to_contain_text("guidance.max_step_m: found -3")
    assert desk.active.guidance.max_step_m == 0.8


# ---------------------------------------------------------------------- recordings


def test_two_settings_are_compared_side_by_side(serve: Callable[..., Served], open_page: Open) -> None:
    page = open_page(serve(), "recordings")
    expect(page.locator("#player-facts")).to_contain_text("220 pictures")
    page.get_by_role("button", name="One picture on").click()
    expect(page.locator("#player-time")).to_contain_text("2 / 220")
    page.locator("#scrub").fill("100")
    expect(page.locator("#player-time")).to_contain_text("101 / 220")
    wait_for(page, "document.querySelector('#lanes canvas').dataset.picture === '100'")
    expect(page.locator("#try-b select").first).to_have_value("detector.method")
    page.get_by_label("from picture").fill(str(FIRST - 4))
    page.get_by_label("to", exact=True).fill(str(FIRST + 4))
    page.get_by_role("button", name="Compare", exact=True).click()
    expect(page.locator("#lanes .lane")).to_have_count(2)
    expect(page.locator("#try-message")).to_contain_text("looked at 9 pictures", timeout=90_000)
    expect(page.locator("#try-table thead")).to_contain_text("B: detector.method = paper")
    page.locator("#scrub").fill(str(FIRST + 4))
    wait_for(page, f"document.querySelector('#lanes canvas').dataset.picture === '{FIRST + 4}'")
    words = page.locator(".lane-words")
    expect(words.nth(0)).to_contain_text("gap")
    expect(words.nth(1)).to_contain_text(" ms")
    assert pixels(page, "#lanes .lane:nth-child(1) canvas") != pixels(
        page, "#lanes .lane:nth-child(2) canvas"
    )
    assert serious_faults(page) == []
    shot(page, "recordings", full_page=True)
    page.get_by_role("button", name="Play").click()
    wait_for(page, f"document.querySelector('#scrub').value > {FIRST + 6}")
    page.get_by_role("button", name="Pause").click()


# ---------------------------------------------------------------------- everybody


@pytest.mark.parametrize(("scheme", "size"), [("dark", LAPTOP), ("light", PHONE)], ids=["laptop", "phone"])
def test_the_page_fits_and_can_be_used_by_everybody(
    flying: Served, open_page: Open, scheme: Any, size: tuple[int, int]
) -> None:
    is_phone = size is PHONE
    page = open_page(flying, size=size, color_scheme=scheme, is_mobile=is_phone, has_touch=is_phone)
    wait_for_pictures(page)
    wait_for(page, "document.querySelector('#answer-words').textContent.startsWith('gap')")
    shot(page, "phone" if is_phone else "live")
    for view, seen in (("live", "#links tr"), ("settings", ".setting"), ("recordings", "#player-card")):
        page.get_by_role("tab", name=view.capitalize()).click()
        expect(page.locator(seen).first).to_be_visible()
        too_wide = page.evaluate(
            "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )
        assert too_wide <= 0, view
        if view == "settings":
            shot(page, f"settings-{'phone' if is_phone else 'laptop'}")
            page.get_by_label("Search settings").fill("step")  # all kinds of rows, and not all rows
            expect(page.get_by_label("agree_deg")).to_be_hidden()
            expect(page.locator("#set-guidance-max_step_m")).to_be_visible()
        assert serious_faults(page) == [], view


def test_the_page_is_used_by_keyboard_alone(flying: Served, open_page: Open) -> None:
    page = open_page(flying)
    wait_for_pictures(page)
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the content")).to_be_focused()
    page.keyboard.press("Tab")
    expect(page.get_by_role("tab", name="Live")).to_be_focused()
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("tab", name="Settings")).to_be_focused()
    expect(page.locator("#view-settings")).to_be_visible()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Tab")
    expect(page.locator("#theme")).to_be_focused()
    page.keyboard.press("Enter")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    page.keyboard.press("Enter")
    assert page.evaluate("document.documentElement.dataset.theme") == "light"
    page.keyboard.press("Tab")
    first = page.get_by_role("checkbox", name="Direction")
    expect(first).to_be_focused()
    page.keyboard.press("Space")
    expect(first).not_to_be_checked()


def test_the_token_is_asked_for_and_taken(
    serve: Callable[..., Served], browser: Browser, tmp_path: Path
) -> None:
    token_file = tmp_path / "token"
    token_file.write_text("correct-horse-battery\n")
    token_file.chmod(0o600)
    served = serve(token_file=str(token_file))
    context = browser.new_context()
    page = context.new_page()  # not open_page: a refusal is an error to the browser's console
    page.set_default_timeout(PATIENCE_MS)
    page.goto(served.url)
    page.get_by_label("Token").fill("wrong-token-of-length")
    page.get_by_role("button", name="Open the page").click()
    expect(page.locator("#login-error")).to_contain_text("not the token", timeout=PATIENCE_MS)
    page.get_by_label("Token").fill("correct-horse-battery")
    page.get_by_role("button", name="Open the page").click()
    expect(page.locator("#connection-text")).to_have_text("live", timeout=PATIENCE_MS)
    page.goto("about:blank")
    context.close()
