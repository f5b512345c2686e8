"""One page in headless Chromium, spoken to over the DevTools protocol, and what every check of it needs.

Needs chromium (Debian package) and websocket-client.
"""

import base64
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request

import websocket

FAILED = []


def check(what, ok, found=""):
    print(f"{'ok  ' if ok else 'FAIL'} {what}" + (f" ({found})" if found != "" else ""))
    if not ok:
        FAILED.append(what)


class Browser:
    """One page in headless Chromium, spoken to over the DevTools protocol."""

    def __init__(self):
        program = shutil.which("chromium") or shutil.which("chromium-browser")
        if program is None:
            print("skipped: chromium is not installed (apt-get install --no-install-recommends chromium)")
            sys.exit(0)
        self.profile = tempfile.mkdtemp(prefix="planish-browser-")
        self.process = subprocess.Popen(
            [program, "--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0",
             "--remote-allow-origins=*", "--hide-scrollbars", "--no-first-run", "--disable-dev-shm-usage",
             f"--user-data-dir={self.profile}", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        port_file = pathlib.Path(self.profile, "DevToolsActivePort")
        for _ in range(600):
            if port_file.exists() and port_file.read_text().strip():
                break
            time.sleep(0.1)
        port = port_file.read_text().split()[0]
        pages = json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json"))
        page = next(p for p in pages if p["type"] == "page")
        self.socket = websocket.create_connection(page["webSocketDebuggerUrl"], timeout=120)
        self.number = 0
        self.events = []
        # What this program itself causes: it reads drawings back.
        self.own = "willReadFrequently"
        for domain in ["Page", "Runtime", "Log", "Network", "DOM"]:
            self.call(domain + ".enable")

    def call(self, method, **parameters):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv())
            if message.get("id") == self.number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self.events.append(message)

    def js(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{expression}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def settle(self):
        """Two frames after everything that was asked for."""
        self.js("new Promise((r) => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(r)), 220))")

    def size(self, width, height, dark=False, scale=1):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False)
        scheme = "dark" if dark else "light"
        self.call("Emulation.setEmulatedMedia", media="screen", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def open(self, path):
        self.call("Page.navigate", url=path.resolve().as_uri())
        for _ in range(600):
            if self.js("document.readyState") == "complete" and self.js("!!window.planish"):
                break
            time.sleep(0.05)
        self.settle()

    def mouse(self, kind, x, y, **more):
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x, y, count=1):
        self.mouse("mouseMoved", x, y)
        for i in range(1, count + 1):
            self.mouse("mousePressed", x, y, button="left", clickCount=i, buttons=1)
            self.mouse("mouseReleased", x, y, button="left", clickCount=i)
        self.settle()

    def key(self, name, text=None, shift=False):
        codes = {"Tab": 9, "Enter": 13, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Home": 36}
        common = {"key": name, "windowsVirtualKeyCode": codes.get(name, ord(name[0].upper())), "modifiers": 8 if shift else 0}
        if name not in ("+", "-", "0"):
            common["code"] = name
        self.call("Input.dispatchKeyEvent", type="keyDown" if text else "rawKeyDown", **common, **({"text": text} if text else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **common)

    def shot(self, path, whole=False):
        height = self.js("document.documentElement.scrollHeight") if whole else self.js("innerHeight")
        width = self.js("innerWidth")
        clip = {"x": 0, "y": 0 if whole else self.js("scrollY"), "width": width, "height": height, "scale": 1}
        data = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)["data"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(data))

    def complaints(self):
        """Console errors, exceptions, and requests to anything but files."""
        found = []
        for e in self.events:
            p = e.get("params", {})
            if e["method"] == "Runtime.exceptionThrown":
                found.append(p["exceptionDetails"].get("exception", {}).get("description", "exception"))
            if e["method"] == "Runtime.consoleAPICalled" and p["type"] in ("error", "warning"):
                found.append(str([a.get("value") for a in p["args"]]))
            if e["method"] == "Log.entryAdded" and p["entry"]["level"] in ("error", "warning"):
                found.append(p["entry"]["text"])
            if e["method"] == "Network.requestWillBeSent" and not p["request"]["url"].startswith(("file:", "data:", "blob:")):
                found.append("request to " + p["request"]["url"])
        return [text for text in found if self.own not in text]

    def close(self):
        self.socket.close()
        self.process.terminate()
        self.process.wait()
        shutil.rmtree(self.profile, ignore_errors=True)


def panel(browser, name):
    """Brings a panel into view; its place on the screen."""
    browser.js(f"document.querySelector('[data-panel=\"{name}\"]').scrollIntoView({{block: 'center'}})")
    browser.settle()
    return browser.js(f"(() => {{ const r = document.querySelector('[data-panel=\"{name}\"]').getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; }})()")


def on_screen(browser, name, x_mm, y_mm):
    return browser.js(f"(() => {{ const p = planish.panels.find((q) => q.name === '{name}'), r = p.canvas.getBoundingClientRect(), b = p.box(); return [r.left + b.x.at({x_mm}), r.top + b.y.at({y_mm})]; }})()")


def read_text(browser, name):
    return browser.js(f"planish.panels.find((p) => p.name === '{name}').read.textContent")
