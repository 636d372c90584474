"""A headless Chromium for tests of pages, and what a page did in it."""

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service

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


def colour_scheme(opened: Chrome, scheme: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def requests(opened: Chrome, page: str) -> set[str]:
    """Addresses that a page requested; an address that holds its data is cut to its scheme, `data:` or `blob:`."""
    events = (json.loads(entry["message"])["message"] for entry in opened.get_log("performance"))
    sent = (event["params"] for event in events if event["method"] == "Network.requestWillBeSent")
    addresses = {params["request"]["url"] for params in sent if params["documentURL"] == page}
    return {re.sub("^(data:|blob:).*", r"\1", address, flags=re.DOTALL) for address in addresses}
