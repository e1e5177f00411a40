"""A headless Chromium, told what to do through its debugging pipe: no driver, no packages, no network."""

import base64
import contextlib
import fcntl
import itertools
import json
import os
import select
import shutil
import subprocess
import time

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run", "--mute-audio",
    "--disable-background-networking", "--disable-component-update", "--remote-debugging-pipe",
)  # fmt: skip
LAPTOP, PHONE = (1366, 900), (390, 844)


def program():
    """The browser of this machine, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One process; `open` loads a file in a tab of its own. A context manager: leaving it ends the process."""

    def __init__(self, profile, patience=60.0):
        requests, self._requests = os.pipe()
        self._answers, answers = os.pipe()
        # The browser reads at 3 and writes at 4; copies far above these do not get into each other's way.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 100) for end in (requests, answers)]
        shell = f'exec "$@" 3<&{ends[0]} 4>&{ends[1]}'
        command = ["bash", "-c", shell, "bash", program(), *FLAGS, f"--user-data-dir={profile}"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(command, pass_fds=ends, **quiet)
        for end in (requests, answers, *ends):
            os.close(end)
        self._count, self._patience, self._rest = itertools.count(1), patience, b""
        self.events = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        with contextlib.suppress(OSError):
            self.call("Browser.close")
        self._process.wait(timeout=20)
        os.close(self._requests)
        os.close(self._answers)

    def call(self, method, session=None, **parameters):
        """The answer to one command of the DevTools protocol; events on the way are kept."""
        number = next(self._count)
        told = {"id": number, "method": method, "params": parameters} | ({"sessionId": session} if session else {})
        os.write(self._requests, json.dumps(told).encode() + b"\0")
        while True:
            message = self._next()
            if message.get("id") == number:
                assert "error" not in message, (method, message["error"])
                return message["result"]

    def wait_for(self, method, session):
        """Reads on until an event has come."""
        while not any(event["method"] == method and event.get("sessionId") == session for event in self.events):
            self._next()

    def _next(self):
        deadline = time.monotonic() + self._patience
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._answers], [], [], deadline - time.monotonic())
            assert ready, "the browser does not answer"
            found = os.read(self._answers, 1 << 16)
            assert found, "the browser has gone"
            self._rest += found
        line, self._rest = self._rest.split(b"\0", 1)
        message = json.loads(line)
        if "method" in message:
            self.events.append(message)
        return message

    def open(self, path, size, touch=False):
        return Tab(self, path, size, touch)


class Tab:
    """A loaded page: what it asked of the network, what it complained about, what its scripts say."""

    def __init__(self, browser, path, size, touch):
        self._browser = browser
        target = browser.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = browser.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")
        width, height = size
        shape = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": touch}
        self._call("Emulation.setDeviceMetricsOverride", **shape)
        if touch:
            self._call("Emulation.setTouchEmulationEnabled", enabled=True)
        self._call("Page.navigate", url=path.resolve().as_uri())
        browser.wait_for("Page.loadEventFired", self._session)
        self.value("new Promise((done) => requestAnimationFrame(() => setTimeout(done, 100)))")

    def _call(self, method, **parameters):
        return self._browser.call(method, self._session, **parameters)

    def _events(self, method):
        for event in self._browser.events:
            if event["method"] == method and event.get("sessionId") == self._session:
                yield event["params"]

    def value(self, script):
        """What a script evaluates to; promises are awaited."""
        told = self._call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in told, told
        return told["result"].get("value")

    def requests(self):
        """Addresses that were asked for, the page itself and what it holds left out."""
        urls = [event["request"]["url"] for event in self._events("Network.requestWillBeSent")]
        return [url for url in urls[1:] if not url.startswith(("data:", "blob:"))]

    def complaints(self):
        """Errors and warnings of the page's scripts and of the browser about it, without its hints on drawing speed."""
        thrown = [event["exceptionDetails"] for event in self._events("Runtime.exceptionThrown")]
        said = [event for event in self._events("Runtime.consoleAPICalled") if event["type"] in ("error", "warning")]
        logged = [event["entry"] for event in self._events("Log.entryAdded")]
        logged = [entry for entry in logged if (entry["source"], entry["level"]) != ("rendering", "warning")]
        return [*thrown, *said, *logged]

    def screenshot(self, path, whole=False):
        shot = self._call("Page.captureScreenshot", format="png", captureBeyondViewport=whole, **self._clip(whole))
        path.write_bytes(base64.b64decode(shot["data"]))

    def _clip(self, whole):
        if not whole:
            return {}
        width, height = self.value("[document.documentElement.clientWidth, document.documentElement.scrollHeight]")
        return {"clip": {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}}
