"""A headless Chromium for tests of pages, and what a page did in it."""

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from selenium.common.exceptions import TimeoutException
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

ABSENT = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
OPTIONS = [
    *("headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "hide-scrollbars"),
    *("disable-background-networking", "disable-component-update", "disable-sync"),
    "force-prefers-reduced-motion",  # otherwise a click may miss its moving target
]


@contextmanager
def browser(profile: Path) -> Iterator[Chrome]:
    """A Chromium with an empty profile, which logs messages of the console and requests."""
    options = ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for option in (*OPTIONS, f"user-data-dir={profile}"):
        options.add_argument(f"--{option}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    opened = Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        yield opened
    finally:
        opened.quit()


def window(opened: Chrome, width: int, height: int) -> None:
    """Set the width of the page, even below 500 pixels, the narrowest window."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def widths(opened: Chrome, expected: int) -> list[int]:
    """Widths of the screen and of what is on it; charts follow the width with a delay."""
    script = "return [innerWidth, document.documentElement.scrollWidth]"
    with suppress(TimeoutException):
        WebDriverWait(opened, 5).until(lambda _: opened.execute_script(script) == [expected, expected])
    return opened.execute_script(script)


def draw_charts(opened: Chrome) -> int:
    """Scroll through the page until every chart is drawn; return the number of charts."""
    charts = opened.find_elements(By.CLASS_NAME, "chart")
    for chart in charts:
        opened.execute_script("arguments[0].scrollIntoView({behavior: 'instant'})", chart)
        WebDriverWait(opened, 10).until(lambda _, own=chart: own.find_elements(By.CSS_SELECTOR, "svg.main-svg"))
    return len(charts)


def write(opened: Chrome, field: WebElement, text: str) -> None:
    """Write a text into a field, in place of the one before."""
    script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'))"
    opened.execute_script(script, field, text)


def numbers(opened: Chrome, table: str, column: int) -> list[float | None]:
    """Numbers in the column of a table, None for gaps."""
    script = f"return [...document.querySelectorAll('#{table} tbody tr')].map(row => row.cells[{column}].textContent)"
    texts = [text.replace("★", "").strip() for text in opened.execute_script(script)]
    return [None if text == "–" else float(text) for text in texts]


def brightness(opened: Chrome, scheme: str) -> list[int]:
    """Sums of red, green and blue in a colour scheme: of the page, and of the text of its charts."""
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    colours = (
        "return [getComputedStyle(document.body).backgroundColor,"
        " getComputedStyle(document.querySelector('.chart text')).fill]"
    )
    script = f"const done = arguments[0]; setTimeout(() => done((() => {{ {colours} }})()), 500)"
    return [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in opened.execute_async_script(script)]


def requests(opened: Chrome, page: str) -> set[str]:
    """Addresses that a page requested; an address that holds its data is cut to its scheme, `data:` or `blob:`."""
    events = (json.loads(entry["message"])["message"] for entry in opened.get_log("performance"))
    sent = (event["params"] for event in events if event["method"] == "Network.requestWillBeSent")
    addresses = {params["request"]["url"] for params in sent if params["documentURL"] == page}
    return {re.sub("^(data:|blob:).*", r"\1", address, flags=re.DOTALL) for address in addresses}
