"""Chromium without a window, driven through chromedriver's own protocol (W3C WebDriver: JSON over HTTP)."""

import base64
import contextlib
import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
MISSING = None if CHROMIUM and DRIVER else "no chromium and chromedriver (apt-get install chromium-driver)"
# Software WebGL; the sandbox needs more rights than a container has.
FLAGS = ("--headless", "--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader", "--hide-scrollbars")


class Browser:
    """One page. Every call waits for its answer."""

    def __init__(self, port: int, size: tuple[int, int]) -> None:
        self._root = f"http://127.0.0.1:{port}"
        wanted = {
            "goog:chromeOptions": {"binary": CHROMIUM, "args": [*FLAGS, "--window-size={},{}".format(*size)]},
            "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
        }
        session = self._ask("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._root += f"/session/{session['sessionId']}"

    def open(self, path: Path, timeout: float = 120.0) -> None:
        """Open a file and wait until it says that it is drawn."""
        self._ask("POST", "/url", {"url": path.resolve().as_uri()})
        end = time.monotonic() + timeout
        while not self.run("return document.body.dataset.ready || ''"):
            if time.monotonic() > end:
                raise TimeoutError(f"{path} is not ready after {timeout:g} s: {self.log('browser')}")
            time.sleep(0.1)

    def visit(self, address: str) -> None:
        """Open an address."""
        self._ask("POST", "/url", {"url": address})

    def fresh(self) -> "Browser":
        """An empty page and empty logs, for the next who comes."""
        self.visit("about:blank")
        for kind in ("browser", "performance"):
            self.log(kind)
        return self

    @contextlib.contextmanager
    def before_pages(self, script: str) -> Iterator[None]:
        """A script that every page runs before its own, for as long as the block lasts."""
        name = self._protocol("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
        try:
            yield
        finally:
            self._protocol("Page.removeScriptToEvaluateOnNewDocument", identifier=name)

    def type(self, text: str) -> None:
        """Keys, to what has the focus."""
        keys = [{"type": kind, "value": letter} for letter in text for kind in ("keyDown", "keyUp")]
        self._ask("POST", "/actions", {"actions": [{"type": "key", "id": "keys", "actions": keys}]})

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script returns."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def screenshot(self) -> bytes:
        """PNG of the window."""
        return base64.b64decode(self._ask("GET", "/screenshot"))

    def pointer(self, *steps: tuple[str, float, float]) -> None:
        """`move`, `down` and `up` of the mouse at pixels of the window."""
        actions = []
        for kind, x, y in steps:
            actions.append({"type": "pointerMove", "x": round(x), "y": round(y), "duration": 20})
            if kind != "move":
                actions.append({"type": f"pointer{kind.capitalize()}", "button": 0})
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": actions}
        self._ask("POST", "/actions", {"actions": [mouse]})

    def log(self, kind: str) -> list[dict[str, Any]]:
        """What came since the last call: of `browser` (the console) or `performance` (events of the protocol)."""
        return self._ask("POST", "/se/log", {"type": kind})

    def requests(self) -> list[str]:
        """Addresses that were asked for since the last call."""
        events = [json.loads(entry["message"])["message"] for entry in self.log("performance")]
        return [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]

    def errors(self) -> list[str]:
        """What the console called an error since the last call."""
        return [entry["message"] for entry in self.log("browser") if entry["level"] == "SEVERE"]

    def quit(self) -> None:
        """End the browser."""
        self._ask("DELETE", "")

    def _protocol(self, command: str, **parameters: Any) -> Any:
        return self._ask("POST", "/goog/cdp/execute", {"cmd": command, "params": parameters})

    def _ask(self, method: str, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._root + path, data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=180) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(f"{method} {path}: {error.read().decode()[:2000]}") from error


@contextlib.contextmanager
def browser(size: tuple[int, int] = (1300, 1000)) -> Iterator[Browser]:
    """A browser for as long as the block lasts."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with subprocess.Popen(
        [str(DRIVER), f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as driver:
        try:
            for _ in range(100):
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                    break
                time.sleep(0.1)
            page = Browser(port, size)
            try:
                yield page
            finally:
                page.quit()
        finally:
            driver.terminate()
