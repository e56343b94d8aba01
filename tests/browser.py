"""A headless browser for tests, driven through a pipe by the DevTools protocol."""

import contextlib
import fcntl
import json
import os
import select
import shutil
import signal
import time

import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--remote-debugging-pipe"
).split()
PATIENCE = 30.0
# Methods of events, and kinds of calls of the console
COMPLAINTS = (
    ("Runtime.exceptionThrown", "Log.entryAdded"),
    ("error", "warning", "assert"),
)


def find_browser():
    """Return the path of a browser, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A browser with one page; messages that are no answers are in `events`."""

    def __init__(self, program, profile):
        # The browser reads from its file 3 and writes to its file 4.
        theirs_in, self._to = os.pipe()
        self._from, theirs_out = os.pipe()
        files = theirs_in, theirs_out
        high = [fcntl.fcntl(file, fcntl.F_DUPFD, 20) for file in files]
        quiet = os.open(os.devnull, os.O_RDWR)
        places = zip([quiet, quiet, *high], [1, 2, 3, 4], strict=True)
        command = [program, *FLAGS, f"--user-data-dir={profile}", "about:blank"]
        moves = [(os.POSIX_SPAWN_DUP2, *place) for place in places]
        spawn = os.posix_spawn
        self._process = spawn(program, command, os.environ, file_actions=moves)
        for file in (theirs_in, theirs_out, quiet, *high):
            os.close(file)
        self._rest, self._number, self._session = b"", 0, None
        self.events = []
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(target for target in targets if target["type"] == "page")
        attached = {"targetId": page["targetId"], "flatten": True}
        self._session = self.call("Target.attachToTarget", **attached)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def close(self):
        """End the browser and wait for it."""
        with contextlib.suppress(OSError):
            self._send("Browser.close", {}, None)
        for file in (self._to, self._from):
            os.close(file)
        until = time.monotonic() + 5
        while os.waitpid(self._process, os.WNOHANG)[0] == 0:
            if time.monotonic() > until:
                os.kill(self._process, signal.SIGKILL)
            time.sleep(0.02)

    def call(self, method, **parameters):
        """Call a method of the protocol and return its answer."""
        number = self._send(method, parameters, self._session)
        while True:
            message = self._receive()
            if message.get("id") != number:
                self.events.append(message)
            elif "error" in message:
                raise RuntimeError(f"{method}: {message['error']}")
            else:
                return message["result"]

    def open(self, url, width=1200, height=800, mobile=False):
        """Show a page in a window of a size, with no events before it."""
        self.events.clear()
        size = {"width": width, "height": height, "mobile": mobile}
        self.call("Emulation.setDeviceMetricsOverride", deviceScaleFactor=1, **size)
        self.call("Page.navigate", url=url)
        self.wait("document.readyState === 'complete'")

    def run(self, code):
        """Return the value of an expression, once it is known."""
        options = {"returnByValue": True, "awaitPromise": True}
        answer = self.call("Runtime.evaluate", expression=code, **options)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{code}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def array(self, code):
        """Return the value of an expression as points (n_points, 3)."""
        return np.reshape(self.run(code), (-1, 3))

    def at(self, name, what):
        """Return what an element has, or do what it can."""
        return self.run(f"document.getElementById('{name}').{what}")

    def click(self, name):
        """Click an element."""
        self.at(name, "click()")

    def box(self, name):
        """Return the left and upper edge of an element, its width and its height."""
        box = self.at(name, "getBoundingClientRect().toJSON()")
        return [box[side] for side in ("x", "y", "width", "height")]

    def wait(self, condition):
        """Wait until a condition is true."""
        until = time.monotonic() + PATIENCE
        while not self.run(condition):
            if time.monotonic() > until:
                raise TimeoutError(condition)
            time.sleep(0.02)

    def drag(self, start, end):
        """Drag with the mouse."""
        button = {"button": "left", "buttons": 1, "clickCount": 1}
        kinds = "mousePressed", "mouseMoved", "mouseReleased"
        for kind, (x, y) in zip(kinds, (start, end, end), strict=True):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def press(self, key, code=0):
        """Press a key."""
        keys = {"key": key, "code": key, "windowsVirtualKeyCode": code}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, **keys)

    def complaints(self):
        """Return what errors and warnings came up since the page was opened."""
        self.run("new Promise(requestAnimationFrame)")
        methods, kinds = COMPLAINTS
        return [
            event
            for event in self.events
            if event["method"] in methods or event["params"].get("type") in kinds
        ]

    def requests(self):
        """Return the addresses that were asked for since the page was opened."""
        sent = [e for e in self.events if e["method"] == "Network.requestWillBeSent"]
        return [event["params"]["request"]["url"] for event in sent]

    def _send(self, method, parameters, session):
        """Send a call and return its number."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        content = json.dumps(message).encode() + b"\0"
        while content:
            content = content[os.write(self._to, content) :]
        return self._number

    def _receive(self):
        """Return the next message."""
        while b"\0" not in self._rest:
            ready, *_ = select.select([self._from], [], [], PATIENCE)
            got = os.read(self._from, 1 << 16) if ready else b""
            if not got:
                raise TimeoutError("the browser does not answer, or has gone")
            self._rest += got
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)
