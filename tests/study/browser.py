"""A person at a real browser: Chromium, where it is installed, without a window."""

from __future__ import annotations

import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import uvicorn
from axe_core_python.selenium import Axe
from selenium.webdriver import ActionChains, Chrome, ChromeOptions, ChromeService
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.wait import WebDriverWait

from torchrl_pref.study.study import Study
from torchrl_pref.study.web import make_app

DESKTOP, PHONE = (1280, 800), (390, 844)

PATIENCE = 20
"""Seconds that something may take on a busy machine."""

needs_chromium = pytest.mark.skipif(
    shutil.which("chromium") is None or shutil.which("chromedriver") is None,
    reason="Chromium and its driver are not installed (Debian: chromium, chromium-driver)",
)


class Browser:
    """What a person does at the page, and sees there."""

    def __init__(self) -> None:
        options = ChromeOptions()
        options.binary_location = shutil.which("chromium") or ""
        for name in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "hide-scrollbars"):
            options.add_argument(f"--{name}")
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = Chrome(options, ChromeService(shutil.which("chromedriver")))

    def size(self, size: tuple[int, int]) -> None:
        """A window, or a phone."""
        phone = size[0] < 600
        for command, settings in (
            (
                "setDeviceMetricsOverride",
                {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": phone},
            ),
            ("setTouchEmulationEnabled", {"enabled": phone}),
        ):
            self.driver.execute_cdp_cmd(f"Emulation.{command}", settings)

    def begin(self, link: str, code: str = "P1") -> None:
        """Open the page and give a code."""
        self.driver.get(link)
        self.wait_for("#code").send_keys(code, Keys.ENTER)
        self.wait_for("#prompt")

    def find(self, selector: str) -> list[WebElement]:
        return self.driver.find_elements(By.CSS_SELECTOR, selector)

    def wait_for(self, selector: str) -> WebElement:
        """The first of such elements that can be seen."""
        return self.until(
            lambda: next(
                (one for one in self.find(selector) if one.text or one.is_displayed()), None
            )
        )

    def until(self, true: Any) -> Any:
        """What a function returns, once that is true."""
        return WebDriverWait(self.driver, PATIENCE, 0.02).until(lambda driver: true())

    def text(self, selector: str = "body") -> str:
        return self.driver.execute_script(
            "return document.querySelector(arguments[0])?.innerText ?? ''", selector
        )

    def press(self, *keys: str) -> None:
        """Press keys, whatever has the focus."""
        ActionChains(self.driver).send_keys(*keys).perform()

    def click(self, label: str) -> None:
        """Press the button that says so."""
        for one in self.find("button"):
            if one.is_displayed() and label in (one.text, one.accessible_name):
                one.click()
                return
        raise AssertionError(f"no button {label!r} in {[one.text for one in self.find('button')]}")

    def answer(self, key: str, next_text: str) -> None:
        """Give an answer by its key, once it can be meant; then wait for what is next."""
        time.sleep(0.35)  # keys pressed sooner after a question were meant for the one before
        self.press(key)
        self.until(lambda: next_text in self.text("#count"))

    def violations(self) -> list[str]:
        """What axe-core finds wrong by WCAG 2.1 A and AA, or by good practice."""
        found = Axe().run(self.driver)["violations"]
        return [f"{one['id']}: {node['html']}" for one in found for node in one["nodes"]]

    def complaints(self) -> list[str]:
        """What the browser itself says is wrong: errors, and what the policy of the page blocks."""
        return [one["message"] for one in self.driver.get_log("browser")]

    def close(self) -> None:
        self.driver.quit()


@contextmanager
def served(study: Study, port: int = 0) -> Iterator[str]:
    """The link to a study that is served while the block lasts."""
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(("127.0.0.1", port))
        listening.listen()  # so that a page asked for at once waits, and is not refused
        host = f"127.0.0.1:{listening.getsockname()[1]}"
        config = uvicorn.Config(
            make_app(study, ("127.0.0.1",), None), log_level="error", lifespan="off"
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
        thread.start()
        try:
            yield f"http://{host}/"
        finally:
            server.should_exit = True
            server.force_exit = True
            thread.join(PATIENCE)
